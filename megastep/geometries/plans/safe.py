"""Reads files of strangers: members of archives with caps, and XML without entities or depth.

Nothing is extracted to disk, nothing is fetched, and every refusal is a ValueError.
"""

import functools
import re
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException, ElementTree

MAX_BYTES = 20 << 20  # of a file
MAX_MEMBERS = 200_000  # of an archive
MAX_TOTAL = 8 << 30  # bytes of an archive, unpacked
MAX_DEPTH = 200  # elements within elements
MAX_ELEMENTS = 200_000
MAX_POINTS = 100_000  # of one list
MAX_COORDINATE = 1e7

BROKEN = (
    *(OSError, EOFError, zipfile.BadZipFile, tarfile.TarError, zlib.error, NotImplementedError),
    RuntimeError,  # of encrypted ones
)
BETWEEN = re.compile(r"[\s,]+|(?<=[\d.])(?=[-+])")  # numbers of a list


class Member(NamedTuple):
    """A file of an archive or folder: its bytes, or why it is refused."""

    name: str
    content: bytes | None
    refusal: str = ""


def members(path: Path, suffix: str) -> Iterator[Member]:
    """Yields the files whose names end in `suffix`, of a zip, a tar, a folder, or the file itself.
    Raises ValueError if there is no such file, or it is damaged or cut short.
    """
    if path.is_dir():
        files = (file for file in sorted(path.rglob(f"*{suffix}")) if file.is_file())
        yield from (of_file(file, file.relative_to(path).as_posix()) for file in files)
        return
    if not path.is_file():
        raise ValueError(f"there is no file or folder {str(path)!r}")
    is_zip, total = zipfile.is_zipfile(path), 0
    if not is_zip and not tarfile.is_tarfile(path):
        if path.suffix.lower() in (".zip", ".gz", ".tgz", ".tar"):
            raise ValueError(f"{str(path)!r} is no archive, or the download is cut short")
        yield of_file(path, path.name)
        return
    try:
        for number, (name, size, open_) in enumerate(_entries(path, is_zip), 1):
            total += size
            if number > MAX_MEMBERS or total > MAX_TOTAL:
                raise ValueError(
                    f"{str(path)!r} has more than {MAX_MEMBERS:,} files or {MAX_TOTAL:,} bytes"
                )
            if not name.endswith(suffix):
                continue
            refusal = _refusal(name, size)
            content = None if refusal else open_().read(size)
            if content is not None and len(content) < size:
                raise EOFError("a file ends too early")
            yield Member(name, content, refusal)
    except BROKEN as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        text = f"{str(path)!r} is damaged or cut short ({reason}); download it again"
        raise ValueError(text) from error


def of_file(path: Path, name: str) -> Member:
    """Returns a file as a member."""
    try:
        refusal = _refusal("", path.stat().st_size)
        return Member(name, None if refusal else path.read_bytes(), refusal)
    except OSError as error:
        return Member(name, None, f"it cannot be read: {error.strerror}")


def _refusal(name, size) -> str:
    """Returns why a file is refused, if it is."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if ".." in parts or name.startswith(("/", "\\")) or ":" in name[:3]:
        return "its name leads out of the archive"
    return f"it has {size:,} bytes, but the limit is {MAX_BYTES:,}" if size > MAX_BYTES else ""


def _entries(path, is_zip) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Yields the name and the bytes of each file of an archive, and a function that opens it."""
    if is_zip:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                yield entry.filename, entry.file_size, functools.partial(archive.open, entry)
    else:
        with tarfile.open(path) as tar:
            for member in tar:
                if member.isfile():
                    yield member.name, member.size, functools.partial(tar.extractfile, member)


# ---- XML ----


def svg(content: bytes) -> Element:
    """Returns the root of an SVG. Raises ValueError for other files, entities, or limits."""
    if not content.strip():
        raise ValueError("it is empty")
    if content.count(b"<") > 2 * MAX_ELEMENTS:  # each begins and ends
        raise ValueError(f"it has more than {MAX_ELEMENTS:,} elements")
    try:
        root = ElementTree.fromstring(content)
    except DefusedXmlException as error:
        raise ValueError(
            "it declares entities, which are refused; open it in Inkscape and save it again as "
            "plain SVG"
        ) from error
    except ParseError as error:
        raise ValueError(f"it is no XML, or cut short ({error})") from error
    if name_of(root) != "svg":
        raise ValueError(f"it is no SVG: its first element is {name_of(root)[:40]!r}")
    level, depth = [root], 0
    while level := [child for element in level for child in element]:
        if (depth := depth + 1) > MAX_DEPTH:
            raise ValueError(f"it has more than {MAX_DEPTH} elements within one another")
    return root


def name_of(element: Element) -> str:
    """Returns an element's name without its namespace; "" of a comment."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def numbers(text: str) -> list[float]:
    """Returns the numbers of a list that commas or blanks separate. Raises ValueError."""
    words = BETWEEN.split(text.strip(" \t\r\n,"))
    if len(words) > 2 * MAX_POINTS:
        raise ValueError(f"a list has more than {MAX_POINTS:,} points")
    try:
        values = [float(word) for word in words if words != [""]]
    except ValueError as error:
        raise ValueError(f"{str(error)[-20:]} is no number") from error
    if not (np.abs(values) <= MAX_COORDINATE).all():
        raise ValueError(f"a coordinate is not finite, or above {MAX_COORDINATE:g}")
    return values


def points(text: str) -> np.ndarray:
    """Returns the points (P, 2) of an SVG list."""
    values = numbers(text)
    if len(values) % 2:
        raise ValueError("a list of points has an odd number of coordinates")
    return np.reshape(values, (-1, 2))
