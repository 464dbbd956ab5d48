"""Lists of geometries in an `.npz` file: arrays `<i>/walls`, `lights`, `masks`, `res` and `id` for
i = 0, 1, ...

Files may come from strangers: sizes are limited, pickled objects are refused, and every error is a
ValueError that names file and geometry.
"""

import lzma
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from megastep import geometry
from megastep.atomic_files import replacing
from megastep.dotdict import dotdict

KEYS = ("walls", "lights", "masks", "res", "id")
MAX_GEOMETRIES = 16_384
# Bytes of all arrays. Masks become int16, so a load takes less than 500 MB with Python itself.
MAX_UNPACKED = 96 << 20
# Metres of all walls of a geometry, and of a file: 20 texels a metre, 16 bytes each.
MAX_LENGTH, MAX_LENGTHS = 20_000, 4_000_000
HEADER = 128  # bytes of the header that numpy writes
# What zipfile and numpy raise for broken files.
UNREADABLE = (
    *(ValueError, EOFError, OSError, SyntaxError, MemoryError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError),
)
NAME = re.compile(r"(0|[1-9][0-9]{0,5})/([A-Za-z_][A-Za-z0-9_]{0,63})\.npy")


def _check_size(n_geometries, n_bytes) -> None:
    if not 1 <= n_geometries <= MAX_GEOMETRIES:
        raise ValueError(f"{n_geometries:,} geometries: allowed are 1 to {MAX_GEOMETRIES:,}")
    if n_bytes > MAX_UNPACKED:
        raise ValueError(f"its arrays have {n_bytes:,} bytes, but the limit is {MAX_UNPACKED:,}")


def _keys_of(archive) -> list[list[str]]:
    """Returns the keys of each geometry. ValueError unless indices run from 0, within limits."""
    keys: dict[int, list[str]] = {}
    entries = archive.zip.infolist()
    for entry in entries:
        match = NAME.fullmatch(entry.filename)
        if not match:
            name = entry.filename[:80]
            raise ValueError(f"holds {name!r}, but only '<number>/<name>.npy' is allowed")
        keys.setdefault(int(match[1]), []).append(match[2])
    _check_size(len(keys), sum(entry.file_size for entry in entries))
    if missing := {*range(len(keys))} - {*keys}:
        raise ValueError(f"must number its geometries from 0 up, but {min(missing)} is missing")
    return [sorted(keys[index]) for index in range(len(keys))]


def _sound(g, before) -> tuple[dict, float]:
    """Returns a validated geometry and the metres of its walls and those `before` it in a file."""
    g = geometry.validate_geometry(g)
    length = float(np.hypot(*(g["walls"][:, 1] - g["walls"][:, 0]).T).sum())
    if length > MAX_LENGTH or before + length > MAX_LENGTHS:
        raise ValueError(
            f"has {length:,.0f} m of walls, and the file {before + length:,.0f} m up to here, but "
            f"the limits are {MAX_LENGTH:,} and {MAX_LENGTHS:,}"
        )
    return g, before + length


def load(path: str | Path) -> list[dotdict]:
    """Returns the geometries of an `.npz` file, without walls of length 0. ValueError, naming file
    and geometry, if the file is missing, broken or too large, or `validate_geometry` refuses one.
    """
    path, place = Path(path), ""
    if not path.is_file():
        raise ValueError(f"There is no geometry file {str(path)!r}. Set path to an .npz file.")
    geometries, length = [], 0.0
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("is no zip file, or is cut short")
        with np.load(path, allow_pickle=False) as archive:
            for index, keys in enumerate(_keys_of(archive)):
                place, g = f", geometry {index}", dotdict()
                for key in keys:
                    place = f", geometry {index}: {key!r} cannot be read"
                    g[key] = np.asarray(archive[f"{index}/{key}"])
                    if g[key].dtype.kind not in "fiub":
                        raise ValueError(f"it has no magic string, or is of dtype {g[key].dtype}")
                place = f", geometry {index}"
                g, length = _sound(g, length)
                geometries.append(g)
    except UNREADABLE as error:
        clause = str(error).strip().split("\n")[0].rstrip(".") or type(error).__name__
        raise ValueError(f"Geometry file {str(path)!r}{place}: {clause}.") from error
    return geometries


def save(path: str | Path, geometries: Sequence[dict]) -> None:
    """Writes geometries, and their further keys that are numbers, to an `.npz` file, atomically.
    ValueError, naming it, if `load` would refuse a geometry.
    """
    path, arrays, length = Path(path), {}, 0.0
    for index, g in enumerate(geometries):
        try:
            g, length = _sound(g, length)
        except ValueError as error:
            raise ValueError(f"Geometry {index} cannot be saved: {error}.") from error
        for key, value in g.items():
            if key in KEYS or np.asarray(value).dtype.kind in "fiub":
                arrays[f"{index}/{key}"] = np.asarray(value)
    _check_size(len(geometries), sum(values.nbytes + HEADER for values in arrays.values()))
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)
