"""Lists of geometries in an `.npz` file: arrays `<i>/walls`, `lights`, `masks`, `res` and `id` for
i = 0, 1, ...

Files may come from strangers. Sizes are checked before anything is unpacked, nothing is written to
disk, pickled objects are refused, and every error is a ValueError that names file and geometry.
"""

import functools
import io
import os
import re
import struct
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Sequence
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict

if TYPE_CHECKING:
    from zipfile import ZipFile

KEYS = ("walls", "lights", "masks", "res", "id")
MAX_GEOMETRIES = 16_384
# Bytes of the zip's table of contents: five entries for each of MAX_GEOMETRIES.
MAX_DIRECTORY = 8 << 20
# Bytes of all arrays. Masks become int16, so a load takes less than 500 MB with Python itself.
MAX_UNPACKED = 96 << 20
MAX_ARRAY = 32 << 20  # bytes of one array: the maximum of cells in the widest dtype
# Metres of all walls of a geometry, and of a file: 20 texels a metre, 16 bytes each.
MAX_LENGTH, MAX_LENGTHS = 20_000, 4_000_000
HEADER = 128  # bytes of the header that numpy writes
MAX_HEADER = 1_024  # bytes of an array's header, which is parsed as Python

# What zipfile and numpy raise for broken files. The last four come from parsing an array's header.
UNREADABLE = (
    ValueError,
    EOFError,
    OSError,
    NotImplementedError,
    zipfile.BadZipFile,
    zlib.error,
    SyntaxError,
    tokenize.TokenError,
    RecursionError,
    MemoryError,
)
NAME = re.compile(r"(0|[1-9][0-9]{0,5})/([A-Za-z_][A-Za-z0-9_]{0,63})\.npy")


def open_zip(path: Path, max_directory: int) -> "ZipFile":
    """Opens a zip file, unless its table of contents has more bytes than that.

    Raises:
        ValueError: what is wrong with the file, without its name.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        # the end record, the longest comment after it, and zip64's two records before it
        file.seek(max(0, size - (22 + 65_535 + 20 + 56)))
        start, tail = file.tell(), file.read()
    at = tail.rfind(b"PK\5\6")
    if at < 0 or len(tail) < at + 22:
        raise ValueError("is no zip file, or is cut short")
    (directory,) = struct.unpack_from("<I", tail, at + 12)
    if at >= 20 and tail[at - 20 : at - 16] == b"PK\6\7":  # zip64, as of more than 65,535 arrays
        (record,) = struct.unpack_from("<Q", tail, at - 12)
        if record != start + at - 76 or tail[at - 76 : at - 72] != b"PK\6\6":
            raise ValueError("has a table of contents of zip64 that is out of place")
        (directory,) = struct.unpack_from("<Q", tail, at - 36)
    if directory > max_directory:
        raise ValueError(
            f"has a table of contents of {directory:,} bytes, but the limit is {max_directory:,}"
        )
    return zipfile.ZipFile(path)


def _contents(archive) -> dict:
    """Returns {geometry index: {key: zip entry}}.

    Raises ValueError unless the archive holds the indices from 0 up, nothing else, and respects the
    limits at the head of this file.
    """
    contents = {}
    for entry in archive.infolist():
        match = NAME.fullmatch(entry.filename)
        if not match:
            raise ValueError(
                f"holds {entry.filename[:80]!r}, but only '<number>/<name>.npy' is allowed"
            )
        if match[2] in contents.setdefault(int(match[1]), {}):
            raise ValueError(f"holds {entry.filename!r} twice")
        contents[int(match[1])][match[2]] = entry
    if not contents:
        raise ValueError("holds no geometry")
    if len(contents) > MAX_GEOMETRIES:
        raise ValueError(f"holds {len(contents):,} geometries, but the limit is {MAX_GEOMETRIES:,}")
    entries = [entry for by_key in contents.values() for entry in by_key.values()]
    for entry in entries:
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            # zipfile unpacks the others whole, whatever size they claim
            raise ValueError(f"holds {entry.filename!r}, which is compressed other than by deflate")
        if entry.file_size > MAX_ARRAY:
            raise ValueError(
                f"holds {entry.filename!r} of {entry.file_size:,} bytes, but the limit is "
                f"{MAX_ARRAY:,}"
            )
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > MAX_UNPACKED:
        raise ValueError(f"unpacks to {unpacked:,} bytes, but the limit is {MAX_UNPACKED:,}")
    if sorted(contents) != list(range(len(contents))):
        missing = min(set(range(len(contents))) - set(contents))
        raise ValueError(f"must number its geometries from 0 up, but {missing} is missing")
    return contents


@functools.lru_cache(maxsize=1024)  # a file has few different headers
def _read_header(start) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Returns (shape, fortran order, dtype) from the first bytes of an array's file."""
    file = io.BytesIO(start)
    version = np.lib.format.read_magic(file)
    reader = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if reader is None:
        raise ValueError(f"has an unknown array format, version {version}")
    return reader(file, max_header_size=MAX_HEADER)


def read_array(archive, entry) -> np.ndarray:
    """Returns the array of a zip entry. Raises ValueError if its header contradicts its size."""
    if entry.flag_bits & 1:
        raise ValueError("is encrypted")
    with archive.open(entry) as file:  # `archive.read` unpacks more than the entry claims
        content = file.read(entry.file_size)
    length = slice(8, 12 if content[6:7] == b"\2" else 10)  # the bytes of the header's length
    offset = length.stop + int.from_bytes(content[length], "little")
    shape, fortran, dtype = _read_header(content[: min(offset, 1 << 16)])
    if dtype.hasobject:
        raise ValueError("is a pickled object, which is never loaded")
    if dtype.kind not in "fiub":
        raise ValueError(f"is of dtype {dtype}, which is not a number")
    n_bytes = entry.file_size - offset
    if prod(shape) * dtype.itemsize != n_bytes:
        raise ValueError(f"claims shape {shape} of {dtype} but holds {n_bytes:,} bytes")
    values = np.frombuffer(content, dtype, offset=offset)
    return values.reshape(shape, order="F" if fortran else "C")


def _read_geometry(archive, entries) -> dict:
    g = dotdict()
    for key, entry in sorted(entries.items()):
        try:
            g[key] = read_array(archive, entry)
        except UNREADABLE as error:
            raise ValueError(f"{key!r} cannot be read: {_clause(error)}") from error
    return geometry.validate_geometry(g)


def _length(g) -> float:
    """Returns the metres of a geometry's walls. Raises ValueError if they exceed MAX_LENGTH."""
    length = float(np.hypot(*(g.walls[:, 1] - g.walls[:, 0]).T).sum())
    if length > MAX_LENGTH:
        raise ValueError(f"has {length:,.0f} m of walls, but the limit is {MAX_LENGTH:,}")
    return length


def _clause(error) -> str:
    """The first line of an error's message, to be put into a sentence."""
    return str(error).strip().split("\n")[0].rstrip(".") or type(error).__name__


def load(path: str | Path) -> list[dotdict]:
    """Returns the list of geometries in an `.npz` file. Walls of length 0 are dropped.

    Raises:
        ValueError: if the file is missing, broken or too large, or if `validate_geometry` refuses a
            geometry. The message names the file and the geometry.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"There is no geometry file {str(path)!r}. Set path to an .npz file.")
    place = ""
    try:
        with open_zip(path, MAX_DIRECTORY) as archive:
            geometries, length = [], 0.0
            for index, entries in sorted(_contents(archive).items()):
                place = f", geometry {index}"
                geometries.append(_read_geometry(archive, entries))
                length += _length(geometries[-1])
                if length > MAX_LENGTHS:
                    raise ValueError(
                        f"up to here the file has {length:,.0f} m of walls, but the limit is "
                        f"{MAX_LENGTHS:,}"
                    )
            return geometries
    except UNREADABLE as error:
        raise ValueError(f"Geometry file {str(path)!r}{place}: {_clause(error)}.") from error


def save(path: str | Path, geometries: Sequence[dict]) -> None:
    """Writes a list of geometries to an `.npz` file, atomically. Further keys are written if they
    are numbers or arrays of numbers.

    Raises:
        ValueError: if `load` would refuse a geometry. The message names it.
    """
    path, arrays, lengths = Path(path), {}, []
    if not 0 < len(geometries) <= MAX_GEOMETRIES:
        raise ValueError(
            f"{len(geometries):,} geometries cannot be saved: give from 1 to {MAX_GEOMETRIES:,}."
        )
    for index, g in enumerate(geometries):
        try:
            g = geometry.validate_geometry(g)
            lengths.append(_length(g))
        except ValueError as error:
            raise ValueError(f"Geometry {index} cannot be saved: {error}.") from error
        for key, value in g.items():
            if key in KEYS or np.asarray(value).dtype.kind in "fiub":
                arrays[f"{index}/{key}"] = np.asarray(value)
    n_bytes = sum(values.nbytes + HEADER for values in arrays.values())
    if n_bytes > MAX_UNPACKED or sum(lengths) > MAX_LENGTHS:
        raise ValueError(
            f"{len(geometries):,} geometries of {n_bytes:,} bytes and {sum(lengths):,.0f} m of "
            f"walls are too many for a file: the limits are {MAX_UNPACKED:,} bytes and "
            f"{MAX_LENGTHS:,} m."
        )
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Writes a file, by `write(file)`, under another name, and renames it once it is whole."""
    handle, partial = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".partial")
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(partial, 0o644)
        os.replace(partial, path)
    except BaseException:
        Path(partial).unlink(missing_ok=True)
        raise
