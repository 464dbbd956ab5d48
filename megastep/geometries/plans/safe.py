"""Reads files of strangers: members of archives with caps, and XML without entities or depth.

Nothing is extracted to disk, nothing is fetched, and every refusal is a ValueError.
"""

import math
import re
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

MAX_BYTES = 20 << 20  # of a file
MAX_MEMBERS = 200_000  # of an archive
MAX_TOTAL = 8 << 30  # bytes of an archive, unpacked
MAX_DEPTH = 200  # elements within elements
MAX_ELEMENTS = 200_000
MAX_POINTS = 100_000  # of one list
MAX_COORDINATE = 1e7

BROKEN = (OSError, EOFError, zipfile.BadZipFile, tarfile.TarError, zlib.error, NotImplementedError)
NUMBER = re.compile(r"[\s,]*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?=[\s,+-]|$)")


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
    with path.open("rb") as file:
        start = file.read(262 + 6)
    is_zip = start[:4] in (b"PK\3\4", b"PK\5\6")
    if not is_zip and start[:2] != b"\x1f\x8b" and start[257:262] != b"ustar":
        if path.suffix.lower() in (".zip", ".gz", ".tgz", ".tar"):
            raise ValueError(f"{str(path)!r} is no archive, or the download is cut short")
        yield of_file(path, path.name)
        return
    try:
        yield from (_of_zip if is_zip else _of_tar)(path, suffix)
    except BROKEN as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        text = f"{str(path)!r} is damaged or cut short ({reason}); download it again"
        raise ValueError(text) from error
    except ValueError as error:
        raise ValueError(f"{str(path)!r} {error}") from error


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


def _check_archive(n_files, n_bytes) -> None:
    if n_files > MAX_MEMBERS or n_bytes > MAX_TOTAL:
        raise ValueError(f"has more than {MAX_MEMBERS:,} files or {MAX_TOTAL:,} bytes")


def _of_zip(path, suffix) -> Iterator[Member]:
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        _check_archive(len(entries), sum(entry.file_size for entry in entries))
        for entry in sorted(entries, key=lambda entry: entry.filename):
            if entry.is_dir() or not entry.filename.endswith(suffix):
                continue
            content, refusal = None, _refusal(entry.filename, entry.file_size)
            try:
                if not refusal:
                    with archive.open(entry) as file:  # `read` of the archive unpacks all there is
                        content = file.read(entry.file_size)
            except (*BROKEN, RuntimeError) as error:  # the last of encrypted ones
                refusal = f"it is damaged or encrypted: {error}"
            yield Member(entry.filename, content, refusal)


def _of_tar(path, suffix) -> Iterator[Member]:
    total = 0
    with tarfile.open(path, "r|*") as archive:
        for number, entry in enumerate(archive, 1):
            total += entry.size
            _check_archive(number, total)
            archive.members = []  # type: ignore[misc]  # which would keep all names
            if not entry.isfile() or not entry.name.endswith(suffix):
                continue
            content, refusal = None, _refusal(entry.name, entry.size)
            if not refusal and (file := archive.extractfile(entry)):
                content = file.read()
                if len(content) < entry.size:
                    raise EOFError("a file ends too early")
            yield Member(entry.name, content, refusal)


# ---- XML ----


class _Builder(ElementTree.TreeBuilder):
    """Builds a tree of limited depth and size."""

    def __init__(self) -> None:
        super().__init__()
        self.depth = self.count = 0

    def start(self, tag, attrs) -> ElementTree.Element:
        self.depth += 1
        self.count += 1
        if self.depth > MAX_DEPTH or self.count > MAX_ELEMENTS:
            raise ValueError(
                f"it has more than {MAX_DEPTH} elements within one another, or {MAX_ELEMENTS:,}"
            )
        return super().start(tag, attrs)

    def end(self, tag) -> ElementTree.Element:
        self.depth -= 1
        return super().end(tag)


def svg(content: bytes) -> ElementTree.Element:
    """Returns the root of an SVG. Raises ValueError for other files, entities, or limits."""
    if not content.strip():
        raise ValueError("it is empty")
    parser = DefusedXMLParser(target=_Builder())
    try:
        parser.feed(content)
        root = parser.close()
    except DefusedXmlException as error:
        raise ValueError(
            "it declares entities, which are refused; open it in Inkscape and save it again as "
            "plain SVG"
        ) from error
    except ElementTree.ParseError as error:
        raise ValueError(f"it is no XML, or cut short ({error})") from error
    if name_of(root) != "svg":
        raise ValueError(f"it is no SVG: its first element is {name_of(root)[:40]!r}")
    return root


def name_of(element: ElementTree.Element) -> str:
    """Returns an element's name without its namespace; "" of a comment."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def numbers(text: str) -> list[float]:
    """Returns the numbers of a list that commas or blanks separate. Raises ValueError."""
    values, at, text = [], 0, text.strip()
    while at < len(text):
        match = NUMBER.match(text, at)
        if match is None:
            raise ValueError(f"{text[at : at + 20]!r} is no number")
        values.append(float(match[1]))
        at = match.end()
        if len(values) > 2 * MAX_POINTS:
            raise ValueError(f"a list has more than {MAX_POINTS:,} points")
    if not all(map(math.isfinite, values)) or max(map(abs, values), default=0) > MAX_COORDINATE:
        raise ValueError(f"a coordinate is not finite, or above {MAX_COORDINATE:g}")
    return values


def points(text: str) -> np.ndarray:
    """Returns the points (P, 2) of an SVG list."""
    values = numbers(text)
    if len(values) % 2:
        raise ValueError("a list of points has an odd number of coordinates")
    return np.reshape(values, (-1, 2))
