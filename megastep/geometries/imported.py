"""The databases of floor plans that `megastep import` has written: CubiCasa5k and HouseExpo.

They lie in the user's data folder, `$XDG_DATA_HOME/megastep`, else `~/.local/share/megastep`, each
as an `.npz` in the form of `homes.database`, with a further array `files`, the number of the file
that each geometry is from. The `.sha256` beside it names the `.npz` and is written last, so that an
import that is interrupted leaves the database as it was.
"""

import functools
import hashlib
import os
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from megastep.atomic_files import write_atomically
from megastep.dotdict import dotdict
from megastep.geometries.homes import database

__all__ = ["NAMES", "folder", "is_database", "load", "pick", "prepare", "write"]

#: The sources that can be imported.
NAMES = ("cubicasa", "houseexpo")
MAX_GEOMETRIES = 100_000


def folder() -> Path:
    """Returns the folder of imported databases."""
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "megastep"


def prepare() -> None:
    """Makes the folder. Raises OSError if it cannot be written, before an import begins."""
    folder().mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder()).close()


def write(name: str, plans: Sequence[dotdict], files: Sequence[int]) -> tuple[Path, str]:
    """Writes the database of a source, atomically: its plans, and the number of the file that each
    is from. Returns its path and sha256. Raises OSError if the folder cannot be written.
    """
    content = database.pack(plans, zipfile.ZIP_DEFLATED, files=np.array(files, "<i4"))
    digest = hashlib.sha256(content).hexdigest()
    folder().mkdir(parents=True, exist_ok=True)
    path = folder() / f"{name}-{digest[:12]}.npz"
    write_atomically(path, content)
    write_atomically(folder() / f"{name}.sha256", f"{digest}  {path.name}\n".encode())
    for old in folder().glob(f"{name}-*.npz"):
        if old != path:
            old.unlink(missing_ok=True)
    return path, digest


@functools.lru_cache(maxsize=2)
def _arrays(name, listing, modified) -> database.Arrays:
    remedy = f"run megastep import source={name} path=... again"
    what = f"The imported plans of {name}"
    return database.read(listing, MAX_GEOMETRIES, what, remedy, ("files",))


def pick(name: str, n: int, split: str, seed: int) -> list[dotdict]:
    """Returns n geometries of an imported database; all of a file are in the same split. Raises
    ValueError if it was not imported, or is damaged.
    """
    listing = folder() / f"{name}.sha256"
    if not listing.exists():
        raise ValueError(
            f"{name} is not imported: there is no {listing}. Download it and run megastep import "
            f"source={name} path=FILE; megastep import --help says where it is to be had"
        )
    plans = _arrays(name, listing, listing.stat().st_mtime_ns)
    of_plans = plans.arrays["files"]
    files = np.unique(of_plans)
    order = np.random.RandomState(0).permutation(len(files))  # numpy never changes what it draws
    of_split = files[order[[*database.split_range(len(files), split)]]]
    members = database.draw(np.isin(of_plans, of_split).nonzero()[0].tolist(), n, seed)
    drawn = {i: plans.home(i, i) for i in members}
    return [drawn[i] for i in members]


def is_database(path: Path) -> bool:
    """True if a file is one that `write` wrote, wherever it lies."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "widths.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile, NotImplementedError):
        return False


def load(path: Path) -> list[dotdict]:
    """Returns all geometries of a database that `write` wrote. Raises ValueError."""
    plans = database.unpack(path.read_bytes(), MAX_GEOMETRIES, "import it again")
    return [plans.home(i, i) for i in range(len(plans.starts) - 1)]
