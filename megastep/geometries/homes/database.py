"""The 5,000 homes that come with the package: `data/homes.npz` and its sha256.

`scripts/make_homes.py` writes them. The arrays of all homes lie end to end: `walls` (M, 2, 2) and
`lights` (K, 2), int16 centimetres, and `masks` (cells,) int8. `widths` (homes, 5) has, per home,
the number of walls, of walls in the outer face, of lights, and the height and width of the masks.
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
    """Returns the arrays of a database and the index at which each home's begin.

    Raises ValueError unless the file's sha256 is the one in the file beside it.
    """
    try:
        content = path.read_bytes()
        expected = path.with_suffix(".sha256").read_text().split()[0]
    except (OSError, IndexError) as error:
        raise ValueError(
            f"The homes in {str(path)!r} cannot be read ({error}); {REMEDY}."
        ) from error
    if hashlib.sha256(content).hexdigest() != expected:
        raise ValueError(f"The homes in {str(path)!r} are damaged (wrong sha256); {REMEDY}.")
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    widths = arrays["widths"]
    sizes = np.stack([widths[:, 0], widths[:, 2], widths[:, 3] * widths[:, 4]], 1)
    return arrays, np.concatenate([np.zeros((1, 3), int), sizes.cumsum(0)])


@functools.lru_cache(maxsize=COUNT)
def home(index: int, outer: bool = True, path: Path = PATH) -> dotdict:
    """Returns the home of seed `index`, a geometry with `n_outer`. `outer` is as in `generate`."""
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
