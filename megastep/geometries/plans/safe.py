"""Reads files of strangers, with caps, and XML without entities or depth.

Nothing is fetched, and every refusal is a ValueError.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException, ElementTree

MAX_BYTES = 20 << 20  # of a file
ARCHIVES = ".zip", ".gz", ".tgz", ".tar"
MAX_DEPTH = 200  # elements within elements
MAX_ELEMENTS = 200_000
MAX_POINTS = 100_000  # of one list
MAX_COORDINATE = 1e7

BETWEEN = re.compile(r"[\s,]+|(?<=[\d.])(?=[-+])")  # numbers of a list


class Member(NamedTuple):
    """A file: its bytes, or why it is refused."""

    name: str
    content: bytes | None
    refusal: str = ""


def members(path: Path, suffix: str) -> Iterator[Member]:
    """Yields the files of a folder with a suffix, or the file. ValueError for an archive."""
    if path.is_dir():
        files = (file for file in sorted(path.rglob(f"*{suffix}")) if file.is_file())
        yield from (of_file(file, file.relative_to(path).as_posix()) for file in files)
    elif not path.is_file():
        raise ValueError(f"there is no file or folder {str(path)!r}")
    elif path.suffix.lower() in ARCHIVES:
        raise ValueError(f"{str(path)!r} is an archive; unpack it, and give its folder")
    else:
        yield of_file(path, path.name)


def of_file(path: Path, name: str) -> Member:
    """Returns a file as a member."""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            return Member(name, None, f"it has {size:,} bytes, but the limit is {MAX_BYTES:,}")
        return Member(name, path.read_bytes())
    except OSError as error:
        return Member(name, None, f"it cannot be read: {error.strerror}")


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
