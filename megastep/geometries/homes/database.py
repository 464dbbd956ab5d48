"""The 5,000 homes that come with the package: `data/homes.npz` and its sha256, written by
`scripts/make_homes.py`.

The arrays of all homes lie end to end, coordinates in centimetres as int16: `walls` (M, 2,
2), `lights` (K, 2) and `masks` (cells,) int8; `widths` (homes, 5) has each home's number of walls,
of those in the outer face, of lights, and its masks' height and width.
"""

import functools
import hashlib
import io
from pathlib import Path

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict

COUNT = 5_000
PATH = Path(__file__).parents[1] / "data" / "homes.npz"
REMEDY = "install megastep again, or run scripts/make_homes.py"


@functools.lru_cache(maxsize=1)
def _arrays(path):
    """A database's arrays and where each home's begin; ValueError unless its sha256 is the one
    beside it.
    """
    try:
        content = path.read_bytes()
        expected = path.with_suffix(".sha256").read_text().split()[0]
    except (OSError, IndexError) as error:
        raise ValueError(
            f"The homes in {str(path)!r} cannot be read ({error}); {REMEDY}."
        ) from error
    if hashlib.sha256(content).hexdigest() != expected:
        raise ValueError(
            f"The homes in {str(path)!r} are damaged (their sha256 is another); {REMEDY}."
        )
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    widths = arrays["widths"]
    sizes = np.stack([widths[:, 0], widths[:, 2], widths[:, 3] * widths[:, 4]], 1)
    return arrays, np.concatenate([np.zeros((1, 3), int), sizes.cumsum(0)])


@functools.lru_cache(maxsize=COUNT)
def home(index: int, outer: bool = True, path: Path = PATH) -> dotdict:
    """The home of seed `index` as a geometry with `n_outer`; `outer` as for `generate`."""
    arrays, starts = _arrays(path)
    _, n_outer, _, height, width = arrays["widths"][index]
    walls, lights, cells = (
        arrays[key][a:b]
        for key, a, b in zip(("walls", "lights", "masks"), starts[index], starts[index + 1])
    )
    return dotdict(
        id=index,
        walls=(walls[: len(walls) if outer else len(walls) - n_outer] / 100).astype(np.float32),
        lights=(lights / 100).astype(np.float32),
        masks=cells.reshape(height, width).astype(np.int16),
        res=geometry.RES,
        n_outer=int(n_outer) if outer else 0,
    )
