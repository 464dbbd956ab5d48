"""The 5,000 homes that come with the package: `data/homes.npz` and its sha256.

`scripts/make_homes.py` writes them. The arrays of all homes lie end to end: `walls` (M, 2, 2),
`doors` (K, 2, 2) and `lights` (L, 2), int16 centimetres, and `masks` (cells,) int8. `widths`
(homes, 6) has, per home, the number of walls, of walls in the outer face, of lights, the height and
width of the masks, and the number of doors.

Denser and cluttered homes are generated when they are first asked for, on all cores, and cached on
disk in the same format.
"""

import functools
import hashlib
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from megastep import cache, geometry, workers
from megastep.dotdict import dotdict
from megastep.geometries import files, homes

COUNT = 5_000
PARTS = ("walls", "lights", "masks", "doors")
#: Bytes of a home and of the headers of arrays, at most; the homes of the package have 3.8 kB.
MAX_EACH, MAX_HEADERS = 1 << 16, 1 << 12
PATH = Path(__file__).parents[1] / "data" / "homes.npz"
PREFIX, MAX_FILES = "homes-", 16  # of files in the cache: of their names, and their number
SEEDS_EACH = 50  # homes per process at least; to start one takes as long as about ten homes
REMEDY = "install megastep again, or run scripts/make_homes.py"


class Arrays(NamedTuple):
    """A database that is read: its arrays, and the index at which each home's begin."""

    arrays: dict[str, np.ndarray]
    starts: np.ndarray

    def home(self, index: int, seed: int, outer: bool = True) -> dotdict:
        """Returns a home, with the id `seed`, and without its outer faces unless `outer`."""
        _, n_outer, _, height, width, _ = self.arrays["widths"][index]
        walls, lights, cells, doors = (
            self.arrays[key][a:b]
            for key, a, b in zip(PARTS, self.starts[index], self.starts[index + 1])
        )
        return dotdict(
            id=seed,
            walls=(walls[: len(walls) if outer else len(walls) - n_outer] / 100).astype(np.float32),
            lights=(lights / 100).astype(np.float32),
            masks=cells.reshape(height, width).astype(np.int16),
            res=geometry.RES,
            doors=(doors / 100).astype(np.float32),
            n_outer=int(n_outer) if outer else 0,
        )


def split_range(count: int, split: str) -> range:
    """Returns the indices of a split, as a range into a database of `count` geometries. A single
    geometry is in every split.
    """
    training = count - max(1, round(count / 10)) if count > 1 else 1
    of_test = range(training if count > 1 else 0, count)
    return {"training": range(training), "test": of_test, "all": range(count)}[split]


def draw(members: Sequence[int], n: int, seed: int) -> list[int]:
    """Returns n of the members: a random permutation of them, repeated."""
    random = np.random.RandomState(seed % 2**32)  # numpy never changes what it draws
    order = random.permutation(len(members))
    return [members[order[i % len(members)]] for i in range(n)]


def pack(
    plans: Sequence[dotdict], compression: int = zipfile.ZIP_LZMA, **further: np.ndarray
) -> bytes:
    """Returns the bytes of a database of homes from `homes.generate`, or of other geometries whose
    coordinates are whole centimetres. `further` are arrays with an entry per home.
    """
    arrays = {
        key: np.concatenate([np.rint(g[key] * 100) for g in plans]).astype("<i2")
        for key in ("walls", "lights", "doors")
    }
    masks = np.concatenate([g.masks.ravel() for g in plans])
    arrays["masks"] = masks.astype("i2" if masks.max() > 127 else "i1")
    widths = [
        (len(g.walls), g.get("n_outer", 0), len(g.lights), *g.masks.shape, len(g.doors))
        for g in plans
    ]
    arrays |= {"widths": np.array(widths, "<i4"), **further}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, values in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # dated 1980: equal homes give equal bytes
            entry.compress_type = compression
            with archive.open(entry, "w") as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
    return buffer.getvalue()


def unpack(
    content: bytes, n_homes: int, remedy: str = REMEDY, further: Sequence[str] = ()
) -> Arrays:
    """Returns a database, with `further` arrays. Raises ValueError, which ends with the remedy, for
    one that cannot be read, or would unpack to more than `n_homes` homes can have.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            n_bytes = sum(entry.file_size for entry in archive.zip.infolist())
            if n_bytes > n_homes * MAX_EACH + MAX_HEADERS:
                raise ValueError(f"it unpacks to more than {n_homes:,} homes can have")
            arrays = {name: archive[name] for name in (*PARTS, "widths", *further)}
    except (*files.UNREADABLE, KeyError) as error:
        raise ValueError(f"The database of homes cannot be read ({error}); {remedy}.") from error
    widths = arrays["widths"]
    sizes = np.stack([widths[:, 0], widths[:, 2], widths[:, 3] * widths[:, 4], widths[:, 5]], 1)
    return Arrays(arrays, np.concatenate([np.zeros((1, 4), int), sizes.cumsum(0)]))


def read(
    listing: Path, n_homes: int, what: str, remedy: str, further: Sequence[str] = ()
) -> Arrays:
    """Returns the database that `listing`, a file of its sha256 and its name, lies beside. Raises
    ValueError, saying of `what` that it cannot be read or has another sha256, and the remedy.
    """
    try:
        digest, name = listing.read_text().split()
        content = listing.with_name(Path(name).name).read_bytes()
    except (OSError, ValueError) as error:
        raise ValueError(f"{what} cannot be read ({error}); {remedy}") from error
    if hashlib.sha256(content).hexdigest() != digest:
        raise ValueError(f"{what} are damaged (wrong sha256); {remedy}")
    return unpack(content, n_homes, remedy, further)


@functools.lru_cache(maxsize=1)
def _packaged(path) -> Arrays:
    return read(path.with_suffix(".sha256"), COUNT, f"The homes in {str(path)!r}", REMEDY)


@functools.lru_cache(maxsize=COUNT)
def home(index: int, outer: bool = True, path: Path = PATH) -> dotdict:
    """Returns the home of seed `index`, with `doors` and `n_outer`."""
    return _packaged(path).home(index, index, outer)


@functools.lru_cache(maxsize=4)
def generated(
    seeds: tuple[int, ...], density: float, clutter: float = 0.0, outer: bool = True
) -> dict[int, dotdict]:
    """Returns {seed: home} of a density and a clutter, from the cache on disk if possible."""
    key = hashlib.sha256(repr((seeds, float(density), float(clutter))).encode())
    for source in *sorted(Path(__file__).parent.glob("*.py")), Path(geometry.__file__):
        key.update(source.read_bytes())
    name = f"{PREFIX}{key.hexdigest()[:20]}"
    content, _ = cache.fetch(name, lambda: _generate(seeds, density, clutter))
    cache.prune(PREFIX, MAX_FILES)
    database = unpack(content, len(seeds))
    return {seed: database.home(index, seed, outer) for index, seed in enumerate(seeds)}


def _generate(seeds, density, clutter) -> bytes:
    import loky

    make = functools.partial(homes.generate, density=density, clutter=clutter)
    n_workers = min(loky.cpu_count(), len(seeds) // SEEDS_EACH)
    if n_workers < 2:
        return pack([make(seed) for seed in seeds])
    with workers.terminal_signals_blocked(), workers.pool(n_workers) as pool:
        return pack(list(pool.map(make, seeds, chunksize=10)))
