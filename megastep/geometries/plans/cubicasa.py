"""Reads CubiCasa5k's `model.svg` (Kalervo et al. 2019): 100 units are a metre, y grows downwards.

Walls are the groups of class Wall or Column, doors and windows are groups within them, rooms are
the groups of class Space; the direct child `polygon` of each is its outline. A floor is a group of
class Floorplan; floors lie side by side, all but the first hidden.
"""

from collections.abc import Iterator
from xml.etree.ElementTree import Element

from svgelements import Matrix

from megastep.geometries.plans import outlines, safe
from megastep.geometries.plans.outlines import Drawing
from megastep.geometries.plans.svg import apply, tokens, transform

SUFFIX = ".svg"
UNITS = 100  # a metre
MAX_BYTES = 2_000_000  # plans of CubiCasa5k have about 100,000
TOLERANCE = outlines.GRID / 2  # metres, by which contours are simplified
SKIPPED = ("defs", "script", "foreignObject", "use", "text", "symbol", "clipPath", "mask")


def read(content: bytes) -> list[Drawing]:
    """Returns the drawings of a file, one per floor. Raises ValueError."""
    if len(content) > MAX_BYTES:
        raise ValueError(f"it has {len(content):,} bytes, but the limit is {MAX_BYTES:,}")
    root = safe.svg(content)
    floors = []
    for floor, matrix in _floors(root, Matrix()):
        floors.append(drawing := Drawing([], [], [], []))
        _collect(floor, matrix, drawing)
    if not floors:
        raise ValueError("it has no group of class Floorplan; is it from CubiCasa5k?")
    floors = [floor for floor in floors if any(floor[:4])]
    if not floors:
        raise ValueError("its floor plan is empty")
    return floors


def _floors(element, above) -> Iterator[tuple[Element, Matrix]]:
    if safe.name_of(element) in SKIPPED or "FloorsCompose" in tokens(element):
        return
    matrix = transform(element.get("transform"), above)
    if "Floorplan" in tokens(element):
        yield element, matrix
        return
    for child in element:
        yield from _floors(child, matrix)


def _collect(element, matrix, drawing) -> None:
    """Adds the walls, doors and rooms within an element."""
    for child in element:
        if safe.name_of(child) != "g":
            continue
        inner, words = transform(child.get("transform"), matrix), tokens(child)
        if "Wall" in words:
            drawing.walls.extend(_polygons(child, inner))
            for opening in child:
                if "Door" in tokens(opening):
                    drawing.doors.extend(
                        _polygons(opening, transform(opening.get("transform"), inner))
                    )
        elif "Space" in words:
            rooms = drawing.outdoors if "Outdoor" in words else drawing.rooms
            parts = _polygons(child, inner)
            if parts:
                rooms.append(outlines.union(parts))
        elif "Column" in words:
            drawing.walls.extend(_polygons(child, inner))
        else:
            _collect(child, inner, drawing)


def _polygons(element, matrix) -> list:
    """Returns the polygons that are an element's direct children, in metres with y up."""
    result = []
    for child in element:
        if safe.name_of(child) == "polygon" and (child.get("points") or "").strip():
            points = apply(
                transform(child.get("transform"), matrix), safe.points(child.get("points") or "")
            )
            result += outlines.ring(points / UNITS * (1, -1))
    return result
