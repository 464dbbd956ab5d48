"""Databases of many geometries: the homes of the package, `data/homes.npz`; denser and cluttered
ones and mazes, generated on all cores when first asked for, and cached on disk; and CubiCasa5k and
HouseExpo, which `megastep import` writes to the user's data folder, `$XDG_DATA_HOME/megastep`, else
`~/.local/share/megastep`.

The arrays of all geometries lie end to end: `walls` (M, 2, 2), `doors` (K, 2, 2) and `lights` (L,
2), int16 centimetres, and `masks` (cells,), integers. `widths` (geometries, 6) has, per geometry,
the number of walls, of walls in the outer face, of lights, the height and width of the masks, and
the number of doors. An imported one has `files`, too: the number of each geometry's file.
"""

import functools
import io
import os
import threading
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from megastep import cache, geometry, workers
from megastep.atomic_files import write_atomically
from megastep.dotdict import dotdict
from megastep.geometries import files, homes

COUNT = 5_000  # homes of the package, of seeds 0 to 4,999
#: The sources that can be imported.
IMPORTED = ("cubicasa", "houseexpo")
MAX_IMPORTED = 100_000
PARTS = ("walls", "lights", "masks", "doors")
#: Bytes of a home and of the headers of arrays, at most; the homes of the package have 3.8 kB.
MAX_EACH, MAX_HEADERS = 1 << 16, 1 << 12
PATH = Path(__file__).parent / "data" / "homes.npz"
#: Of files in the cache: of their names, their number, and their bytes.
PREFIX, MAX_FILES, MAX_BYTES = "homes-", 32, 512e6
SEEDS_EACH = 50  # homes per process at least; to start one takes as long as about ten homes


class Database(NamedTuple):
    """A database that is read: its arrays, and the index at which each geometry's begin."""

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


def read(file: Path | IO[bytes], count: int, remedy: str, further: Sequence[str] = ()) -> Database:
    """Returns a database, with `further` arrays. Raises ValueError, which ends with the remedy, for
    one that cannot be read, or would unpack to more than `count` homes can have.
    """
    try:
        with np.load(file, allow_pickle=False) as archive:
            if sum(e.file_size for e in archive.zip.infolist()) > count * MAX_EACH + MAX_HEADERS:
                raise ValueError(f"it unpacks to more than {count:,} homes can have")
            arrays = {name: archive[name] for name in (*PARTS, "widths", *further)}
    except (*files.UNREADABLE, KeyError, AttributeError) as error:
        name = repr(str(file)) if isinstance(file, Path) else "in the cache"
        raise ValueError(f"The database {name} cannot be read ({error}); {remedy}") from error
    widths = arrays["widths"]
    sizes = np.stack([widths[:, 0], widths[:, 2], widths[:, 3] * widths[:, 4], widths[:, 5]], 1)
    return Database(arrays, np.concatenate([np.zeros((1, 4), int), sizes.cumsum(0)]))


def split_range(count: int, split: str) -> range:
    """Returns the indices of a split of `count` geometries; a single one is in every split."""
    training = count - max(1, round(count / 10)) if count > 1 else 1
    of_test = range(training if count > 1 else 0, count)
    return {"training": range(training), "test": of_test, "all": range(count)}[split]


def draw(members: Sequence[int], n: int, seed: int) -> list[int]:
    """Returns n of the members: a random permutation of them, repeated."""
    random = np.random.RandomState(seed % 2**32)  # numpy never changes what it draws
    order = random.permutation(len(members))
    return [members[order[i % len(members)]] for i in range(n)]


# ---- Homes ----


def prefetch() -> None:
    """Unpacks the homes of the package in a thread, while this one does something else."""
    threading.Thread(target=_packaged, daemon=True).start()


@functools.lru_cache(maxsize=1)
def _packaged() -> Database:
    return read(PATH, COUNT, "install megastep again, or run scripts/make_homes.py")


@functools.lru_cache(maxsize=COUNT)
def home(index: int, outer: bool = True) -> dotdict:
    """Returns the home of seed `index`, with `doors` and `n_outer`."""
    return _packaged().home(index, index, outer)


def dense_home(seed: int, density: float, clutter: float, outer: bool) -> dotdict:
    """Returns the home of a seed as `home` does, of another density or clutter."""
    g = homes.generate(seed, density=density, clutter=clutter)
    n_outer = g.n_outer if outer else 0
    walls = g.walls[: len(g.walls) - g.n_outer + n_outer]
    kept = {key: g[key] for key in ("lights", "masks", "res", "doors")}
    return dotdict(id=seed, walls=walls, **kept, n_outer=n_outer)


def generated(
    generate: Callable[..., dotdict], seeds: Sequence[int], each: int = 500, **options: object
) -> list[dotdict]:
    """Returns generate(seed, **options) of each seed, from the cache on disk if possible, else
    made by processes of at least `each` different seeds.
    """
    distinct = [*dict.fromkeys(seeds)]

    def build() -> list[dotdict]:
        import loky

        make = functools.partial(generate, **options)
        n_workers = min(loky.cpu_count(), len(distinct) // each)
        if n_workers < 2:
            return [make(seed) for seed in distinct]
        with workers.terminal_signals_blocked(), workers.pool(n_workers) as pool:
            return list(pool.map(make, distinct, chunksize=10))

    sources = *sorted(Path(__file__).parent.rglob("*.py")), Path(geometry.__file__)
    parts = *sources, generate.__module__, distinct, *sorted(options.items())
    plans = map(dotdict, cache.records(PREFIX, parts, build, MAX_FILES, MAX_BYTES))
    by_seed = dict(zip(distinct, plans))
    return [by_seed[seed] for seed in seeds]


# ---- Imported floor plans ----


def imported_path(name: str) -> Path:
    """Returns where the imported database of a source lies."""
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "megastep" / f"{name}.npz"


def write_imported(name: str, plans: Sequence[dotdict], file_numbers: Sequence[int]) -> Path:
    """Writes the database of a source, its plans and the number of each one's file. OSError."""
    content = pack(plans, zipfile.ZIP_DEFLATED, files=np.array(file_numbers, "<i4"))
    write_atomically(path := imported_path(name), content)
    return path


@functools.lru_cache(maxsize=2)
def _imported(path, modified) -> Database:
    remedy = f"run megastep import source={path.stem} path=... again"
    return read(path, MAX_IMPORTED, remedy, ("files",))


def pick(name: str, n: int, split: str, seed: int) -> list[dotdict]:
    """Returns n geometries of an imported database; all of a file are in the same split. Raises
    ValueError if it was not imported, or is damaged.
    """
    path = imported_path(name)
    if not path.exists():
        raise ValueError(
            f"{name} is not imported: there is no {path}. Download it and run megastep import "
            f"source={name} path=FILE; megastep import --help says where it is to be had"
        )
    plans = _imported(path, path.stat().st_mtime_ns)
    of_plans = plans.arrays["files"]
    numbers = np.unique(of_plans)
    order = np.random.RandomState(0).permutation(len(numbers))  # numpy never changes what it draws
    of_split = numbers[order[[*split_range(len(numbers), split)]]]
    members = draw(np.isin(of_plans, of_split).nonzero()[0].tolist(), n, seed)
    drawn = {i: plans.home(i, i) for i in members}
    return [drawn[i] for i in members]


def load(path: Path) -> list[dotdict]:
    """Returns all geometries of a database, or else of a file of `files`. Raises ValueError."""
    try:
        with zipfile.ZipFile(path) as archive:
            is_database = "widths.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile, NotImplementedError):
        is_database = False
    if not is_database:
        return files.load(path)
    plans = read(path, MAX_IMPORTED, "import it again")
    return [plans.home(i, i) for i in range(len(plans.starts) - 1)]
