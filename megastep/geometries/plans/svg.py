"""Reads a floor plan that somebody drew: an SVG whose walls, and doors if any, are marked by the
id, class or label of an element, or of a group or layer around it.
"""

import re

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry
from svgelements import Close, Line, Matrix, Move, Path

from megastep.geometries.plans import outlines, safe
from megastep.geometries.plans.cubicasa import SKIPPED, apply, tokens, transform
from megastep.geometries.plans.outlines import Drawing

LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"
CURVE = np.linspace(0, 1, 25)  # points of a curve, which are simplified later
MAX_PATH = 1 << 20  # characters of a path
FILL, STROKE, WIDTH = "fill", "stroke", "stroke-width"


def read(content: bytes, scale: float, walls: str = "wall", doors: str = "door") -> Drawing:
    """Returns the drawing of an SVG.

    Args:
        content: of the file.
        scale: metres per unit of the SVG, after all transforms.
        walls: the mark of walls: an id, perhaps followed by a number, a word of the class, or
            Inkscape's label.
        doors: the mark of doors, in gaps of the walls or upon them.

    Raises:
        ValueError: saying what is wrong with the file.
    """
    root = safe.svg(content)
    marks = {"walls": walls, "doors": doors}
    shapes: dict[str, list[BaseGeometry]] = {key: [] for key in marks}
    _collect(root, Matrix(), {FILL: "black", STROKE: "none", WIDTH: "1"}, "", marks, shapes, scale)
    if not shapes["walls"]:
        raise ValueError(
            f"no shape is marked {walls!r} by id, class or label; walls= names another mark"
        )
    outlines.check_extent(shapes["walls"])
    return outlines.enclosed(shapes["walls"], shapes["doors"])


def is_marked(element, mark: str) -> bool:
    """True if an element's id, class or label is the mark, in any case."""
    mark = mark.lower()
    words = [*tokens(element), element.get(LABEL) or ""]
    name = (element.get("id") or "").lower()
    is_id = re.fullmatch(rf"{re.escape(mark)}s?[-_ ]?\d*", name) is not None
    return is_id or any(word.lower() in (mark, f"{mark}s") for word in words)


def _collect(element, above, style, kind, marks, shapes, scale) -> None:
    """Adds the marked shapes within an element. `kind` is that of a marked group around it."""
    if safe.name_of(element) in SKIPPED:
        return
    style, matrix = _styled(element, style), transform(element, above)
    if style.pop("display", "") == "none":
        return
    kind = next((key for key, mark in marks.items() if is_marked(element, mark)), kind)
    if kind and (lines := _outline(element)):
        lines = [(apply(matrix, line) * (scale, -scale), is_closed) for line, is_closed in lines]
        size = scale * abs(matrix.a * matrix.d - matrix.b * matrix.c) ** 0.5
        shapes[kind] += _solid(lines, style, size)
    for child in element:
        _collect(child, matrix, style, kind, marks, shapes, scale)


def _styled(element, style) -> dict[str, str]:
    """Returns the style of an element within one of another style."""
    declared = re.findall(r"([\w-]+)\s*:\s*([^;]+)", element.get("style") or "")
    own = {key: element.get(key) for key in (FILL, STROKE, WIDTH, "display")} | dict(declared)
    return style | {key: value.strip() for key, value in own.items() if value}


def _length(element, key) -> float:
    """Returns a length of an element in units, 0 if it has none."""
    (value, *_) = safe.numbers(re.sub(r"[a-z%]+$", "", element.get(key) or "0")) or [0.0]
    return value


def _outline(element) -> list[tuple[np.ndarray, bool]]:
    """Returns the lines (P, 2) of a shape, and whether each is closed; none for a group."""
    name = safe.name_of(element)
    x, y, width, height, r = (_length(element, key) for key in ("x", "y", "width", "height", "r"))
    if name == "rect":
        corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
        return [(np.array(corners), True)]
    if name in ("polygon", "polyline"):
        return [(safe.points(element.get("points") or ""), name == "polygon")]
    if name == "line":
        ends = [[_length(element, f"{axis}{i}") for axis in "xy"] for i in (1, 2)]
        return [(np.array(ends), False)]
    if name in ("circle", "ellipse"):
        angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        radii = (r, r) if name == "circle" else (_length(element, "rx"), _length(element, "ry"))
        centre = _length(element, "cx"), _length(element, "cy")
        return [(np.stack([np.cos(angles), np.sin(angles)], 1) * radii + centre, True)]
    return _path(element.get("d") or "") if name == "path" else []


def _path(text) -> list[tuple[np.ndarray, bool]]:
    """Returns the lines of a path with its curves flattened."""
    if len(text) > MAX_PATH:
        raise ValueError(f"a path has {len(text):,} characters, but the limit is {MAX_PATH:,}")
    try:
        segments = list(Path(text))
    except (ValueError, IndexError, TypeError, AttributeError, ZeroDivisionError) as error:
        raise ValueError(f"the path {text[:30]!r} cannot be read") from error
    lines, points, is_closed = [], [], False
    for segment in [*segments, Move((0, 0))]:
        if isinstance(segment, Move):
            if len(points) > 1:
                lines.append((np.array(points), is_closed))
            points, is_closed = [tuple(segment.end)], False
        elif isinstance(segment, Close):
            is_closed = True
        elif isinstance(segment, Line):
            points.append(tuple(segment.end))
        else:
            with np.errstate(all="ignore"):  # what is not finite is refused below
                curve = np.asarray(segment.npoint(CURVE))
            points += [tuple(row) for row in curve[1:].tolist()]
    for line, _ in lines:
        if not np.isfinite(line).all() or np.abs(line).max() > safe.MAX_COORDINATE:
            raise ValueError("a coordinate of a path is not finite, or too large")
    return lines


def _solid(lines, style, size) -> list[BaseGeometry]:
    """Returns the area that a shape covers: what it fills, else what its stroke covers."""
    if style[FILL] != "none" and any(is_closed or len(line) > 2 for line, is_closed in lines):
        area = shapely.Polygon()
        for line, _ in lines:
            area = area.symmetric_difference(shapely.union_all(outlines.ring(line)))
        return [area] if not area.is_empty else []
    if style[STROKE] == "none":
        return []
    width = max(outlines.GRID, size * safe.numbers(re.sub(r"[a-z%]+$", "", style[WIDTH]))[0])
    ends = [np.concatenate([line, line[:1]]) if is_closed else line for line, is_closed in lines]
    return [
        shapely.LineString(line).buffer(width / 2, cap_style="square", join_style="mitre")
        for line in ends
        if len(line) > 1
    ]
