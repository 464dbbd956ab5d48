"""Reads the floor plans of HouseExpo (Li et al. 2019): JSON with the outline of a home's floor, in
metres, and boxes around its rooms. The outline is drawn from a raster of 1 cm.
"""

import json

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from megastep.geometries.plans import outlines
from megastep.geometries.plans.outlines import Drawing

SUFFIX = ".json"
TOLERANCE = 0.02  # metres, by which outlines are simplified
MIN_BOX = 0.3  # m2 of floor that only this box has
MIN_ROOM = 1.0  # m2 of floor outside all boxes that are a room too
MAX_CORNERS, MAX_BOXES = 20_000, 2_000
ROUGH = 0.06  # metres, by which outlines are simplified to find the ends of walls
THICK = 0.6  # metres; walls end in edges of up to that length
WIDTHS = (0.5, 2.0)  # metres; of doorways


def _refuse(text) -> float:
    raise ValueError(f"it has the number {text}")


def read(content: bytes) -> list[Drawing]:
    """Returns the drawing of a file, in a list. Raises ValueError."""
    try:
        plan = json.loads(content, parse_constant=_refuse)
    except (json.JSONDecodeError, RecursionError, UnicodeDecodeError) as error:
        raise ValueError(f"it is no JSON, or cut short ({error})") from error
    if not isinstance(plan, dict) or "verts" not in plan:
        raise ValueError("it has no 'verts'; is it from HouseExpo?")
    corners = _numbers(plan["verts"], 2, "verts")
    if not 4 <= len(corners) <= MAX_CORNERS:
        raise ValueError(f"its outline has {len(corners):,} corners; 4 to {MAX_CORNERS:,} can be")
    outlines.check_meetings([shapely.LineString(corners)])
    floor = max(outlines.ring(corners), key=lambda part: part.area, default=None)
    if floor is None or floor.area < outlines.MIN_AREA:
        raise ValueError(f"its floor has less than {outlines.MIN_AREA:g} m2")
    floor = shapely.simplify(floor, TOLERANCE)
    categories = plan.get("room_category")
    if not isinstance(categories, dict):
        raise ValueError("it has no 'room_category'; is it from HouseExpo?")
    boxes = [row for value in categories.values() for row in _numbers(value, 4, "room_category")]
    if len(boxes) > MAX_BOXES:
        raise ValueError(f"it has {len(boxes):,} rooms, but the limit is {MAX_BOXES:,}")
    shapes = [
        shapely.box(*np.minimum(row[:2], row[2:]), *np.maximum(row[:2], row[2:])) for row in boxes
    ]
    rooms, taken = [], shapely.Polygon()
    for box in sorted(shapes, key=lambda box: box.area):  # boxes overlap, and the smaller one wins
        parts = outlines.polygons(box.intersection(floor).difference(taken))
        if sum(part.area for part in parts) >= MIN_BOX:
            rooms.append(shapely.union_all(parts))
            taken = taken.union(box)
    rest = floor.difference(shapely.union_all([room.buffer(0.05) for room in rooms]))
    rooms += [part for part in outlines.polygons(rest) if part.area >= MIN_ROOM]
    return [Drawing([], rooms or [floor], _doorways(floor), [], floor)]


def _doorways(floor) -> list[BaseGeometry]:
    """Returns doorways, which no file marks: floor between a wall's end and what it would meet."""
    outline, doors, middles = orient(shapely.simplify(floor, ROUGH)), [], np.zeros((0, 2))
    for ring in (outline.exterior, *outline.interiors):
        points = np.array(ring.coords[:-1])
        steps = np.roll(points, -1, 0) - points  # the floor is on their left
        lengths = np.hypot(*steps.T)
        units = steps / lengths[:, None]
        before, after = np.roll(units, 1, 0), np.roll(units, -1, 0)
        turns = before[:, 0] * units[:, 1] - before[:, 1] * units[:, 0]  # sines; right is below 0
        is_end = (turns < -0.7) & (np.roll(turns, -1) < -0.7) & (lengths <= THICK)
        for i in np.nonzero(is_end)[0]:
            start, ahead = points[i] + steps[i] / 2, before[i] - after[i]
            ahead = ahead / np.hypot(*ahead)
            ray = shapely.LineString([start + 0.01 * ahead, start + WIDTHS[1] * ahead])
            hit = ray.intersection(outline.boundary)
            if hit.is_empty:
                continue
            width = 0.01 + shapely.Point(ray.coords[0]).distance(hit)
            middle = start + width / 2 * ahead
            is_new = (np.hypot(*(middles - middle).T) > THICK).all()
            if width >= WIDTHS[0] and lengths[i] < width and is_new:
                middles = np.concatenate([middles, [middle]])
                line = shapely.LineString([start, start + width * ahead])
                doors.append(line.buffer(lengths[i] / 2, **outlines.MITRE))
    return doors


def _numbers(value, width, name) -> np.ndarray:
    """Returns rows of `width` finite numbers."""
    try:
        rows = np.array(value, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"its {name} are no lists of numbers") from error
    if rows.size == 0:
        return np.zeros((0, width))
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"its {name} are no lists of {width} numbers")
    if not np.isfinite(rows).all() or np.abs(rows).max() > 1e6:
        raise ValueError(f"its {name} are not finite, or too large")
    return rows
