"""Lists of geometries as one `.npz` file: arrays `<i>/walls`, `lights`, `masks`, `res`, `id` for i
= 0, 1, ...

A file may come from anyone, so nothing in it is believed: sizes are checked before anything is
unpacked, nothing is written to disk, pickled objects are refused, and every error is a ValueError
of one sentence naming file and geometry.
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
from collections.abc import Sequence
from math import prod
from pathlib import Path

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict

KEYS = ("walls", "lights", "masks", "res", "id")
MAX_GEOMETRIES = 16_384
# Bytes of the zip's table of contents: five entries for each of the most geometries.
MAX_DIRECTORY = 8 << 20
# Bytes of all arrays; twice that once masks are int16, so under 500 MB with Python itself.
MAX_UNPACKED = 96 << 20
MAX_ARRAY = 32 << 20  # bytes of one array: the most cells in the widest type
MAX_HEADER = 1_024  # bytes of an array's own header, which is parsed as Python; numpy writes 118

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
)  # these by way of an array's header
NAME = re.compile(r"(0|[1-9][0-9]{0,5})/([A-Za-z_][A-Za-z0-9_]{0,63})\.npy")


def _opened(path):
    """The zip file at `path`, its table of contents no larger than we are willing to read."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - (22 + 65_535)))  # the end record and the longest comment after it
        tail = file.read()
    at = tail.rfind(b"PK\5\6")
    if at < 0 or len(tail) < at + 22:
        raise ValueError("is not an .npz file, or it is cut short")
    (directory,) = struct.unpack_from("<I", tail, at + 12)
    if directory > MAX_DIRECTORY:
        raise ValueError(
            f"lists more arrays than {MAX_GEOMETRIES:,} geometries have, which is the limit"
        )
    return zipfile.ZipFile(path)


def _contents(archive):
    """{geometry index: {key: zip entry}} of an archive that holds the indices from 0 up and nothing
    else.
    """
    found = {}
    for entry in archive.infolist():
        match = NAME.fullmatch(entry.filename)
        if not match:
            raise ValueError(
                f"holds {entry.filename[:80]!r}, and only '<number>/<name>.npy' is expected"
            )
        if match[2] in found.setdefault(int(match[1]), {}):
            raise ValueError(f"holds {entry.filename!r} twice")
        found[int(match[1])][match[2]] = entry
    if not found:
        raise ValueError("holds no geometry")
    if len(found) > MAX_GEOMETRIES:
        raise ValueError(f"holds {len(found):,} geometries, and the limit is {MAX_GEOMETRIES:,}")
    for entries in found.values():
        for entry in entries.values():
            if entry.file_size > MAX_ARRAY:
                size = f"{entry.file_size:,} bytes"
                raise ValueError(
                    f"holds {entry.filename!r} of {size}, and the limit is {MAX_ARRAY:,}"
                )
    unpacked = sum(entry.file_size for entries in found.values() for entry in entries.values())
    if unpacked > MAX_UNPACKED:
        raise ValueError(f"unpacks to {unpacked:,} bytes, and the limit is {MAX_UNPACKED:,}")
    if sorted(found) != list(range(len(found))):
        missing = min(set(range(len(found))) - set(found))
        raise ValueError(f"numbers its geometries with a gap: {missing} is missing")
    return found


@functools.lru_cache(maxsize=1024)  # the arrays of a file have few different ones
def _header(start):
    """(shape, fortran order, dtype) from the first bytes of an array's file."""
    file = io.BytesIO(start)
    version = np.lib.format.read_magic(file)
    reader = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if reader is None:
        raise ValueError(f"has an array format {version} that is not known")
    return reader(file, max_header_size=MAX_HEADER)


def _array(archive, entry):
    """The array of one zip entry, refused when its header promises other than the entry holds."""
    if entry.flag_bits & 1:
        raise ValueError("is encrypted")
    content = archive.read(entry)
    counts = slice(8, 12 if content[6:7] == b"\2" else 10)  # where the header's length stands
    offset = counts.stop + int.from_bytes(content[counts], "little")
    shape, fortran, dtype = _header(content[: min(offset, 1 << 16)])
    if dtype.hasobject:
        raise ValueError("is a pickled object, which is never loaded")
    if dtype.kind not in "fiub":
        raise ValueError(f"is of dtype {dtype}, which is not a number")
    held = entry.file_size - offset
    if prod(shape) * dtype.itemsize != held:
        raise ValueError(f"claims shape {shape} of {dtype} but holds {held:,} bytes")
    values = np.frombuffer(content, dtype, offset=offset)
    return values.reshape(shape, order="F" if fortran else "C")


def _geometry(archive, entries):
    g = dotdict()
    for key, entry in sorted(entries.items()):
        try:
            g[key] = _array(archive, entry)
        except UNREADABLE as error:
            raise ValueError(f"{key!r} cannot be read: {_clause(error)}") from error
    return geometry.checked(g)


def _clause(error):
    return str(error).strip().split("\n")[0].rstrip(".") or type(error).__name__


def load(path: str | Path) -> list[dotdict]:
    """The list of geometries in the `.npz` file at `path`; walls of no length are dropped.

    Raises ValueError, one sentence with the file, the geometry and what is allowed, for a file that
    is missing, broken, too large or holds what `geometry.checked` refuses.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"There is no geometry file {str(path)!r}; give the path of an .npz file.")
    where = ""
    try:
        with _opened(path) as archive:
            result = []
            for index, entries in sorted(_contents(archive).items()):
                where = f", geometry {index}"
                result.append(_geometry(archive, entries))
            return result
    except UNREADABLE as error:
        raise ValueError(f"Geometry file {str(path)!r}{where}: {_clause(error)}.") from error


def save(path: str | Path, geometries: Sequence[dict]) -> None:
    """Writes a list of geometries to `path` as `.npz`, all or nothing; of further keys those that
    are numbers.

    Raises ValueError, naming the geometry, for what `load` would refuse.
    """
    path, arrays = Path(path), {}
    if not 0 < len(geometries) <= MAX_GEOMETRIES:
        raise ValueError(
            f"{len(geometries):,} geometries cannot be saved: take 1 to {MAX_GEOMETRIES:,}."
        )
    for index, g in enumerate(geometries):
        try:
            g = geometry.checked(g)
        except ValueError as error:
            raise ValueError(f"Geometry {index} cannot be saved: {error}.") from error
        arrays.update(
            {
                f"{index}/{key}": np.asarray(value)
                for key, value in g.items()
                if key in KEYS or np.asarray(value).dtype.kind in "fiub"
            }
        )
    handle, partial = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".partial")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(partial, 0o644)
        os.replace(partial, path)
    except BaseException:
        Path(partial).unlink(missing_ok=True)
        raise
