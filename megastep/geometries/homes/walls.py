"""The walls of a home as solids, the segments that bound them, and lights. Integer centimetres.

Everything is painted on a grid with a line at each coordinate that occurs, so a cell is wholly
outdoors, wall or indoors.
"""

from collections.abc import Callable, Sequence

import numpy as np

from megastep.geometries.homes import regions
from megastep.geometries.homes.openings import Contact, Opening
from megastep.geometries.homes.portable_generator import PortableGenerator

Grid = tuple[np.ndarray, np.ndarray, np.ndarray]  # xs, ys, cells

OUTDOORS, WALL, INDOORS = 0, 1, 2
# cm along x or y between a light and any wall, so that no wall touches its cell of the masks
CLEAR = 21
SHORTEST, LONGEST = 60, 150  # cm that a slanted corner takes off either side


def depths(sides: dict, thickness: int) -> Callable:
    """Returns a function from a contact to (before, after), the cm that its wall reaches on either
    side of its line. `sides` is a result of `partition`.
    """
    around = {
        0: (thickness // 2, thickness - thickness // 2),
        1: (0, thickness),
        -1: (thickness, 0),
    }
    return lambda contact: around[sides.get((contact.axis, contact.at), 0)]


def _rectangle(axis, across, along) -> regions.Rectangle:
    """Returns a rectangle from its extents along `axis` and along the other axis."""
    (a, b), (c, d) = across, along
    return (a, c, b, d) if axis == 0 else (c, a, d, b)


def solids(meetings: Sequence[Contact], depth: Callable) -> regions.Region:
    """Returns the rectangle of each contact's wall, long enough to fill the corners with others."""
    rectangles = []
    for contact in meetings:
        low, high = contact.low, contact.high
        for other in meetings:
            if other.axis != contact.axis and other.low <= contact.at <= other.high:
                before, after = depth(other)
                if other.at == contact.low:
                    low = contact.low - before
                elif other.at == contact.high:
                    high = contact.high + after
        before, after = depth(contact)
        rectangles.append(
            _rectangle(contact.axis, (contact.at - before, contact.at + after), (low, high))
        )
    return rectangles


def gap(opening: Opening, depth: Callable) -> tuple[int, int, int, int]:
    """Returns the rectangle that an opening takes out of its wall."""
    before, after = depth(opening.contact)
    at = opening.contact.at
    return _rectangle(opening.contact.axis, (at - before, at + after), (opening.low, opening.high))


def across(opening: Opening) -> list[tuple[int, int]]:
    """Returns the ends of the segment across an opening, in the middle of its wall."""
    contact = opening.contact
    ends = [(contact.at, opening.low), (contact.at, opening.high)]
    return [(y, x) for x, y in ends] if contact.axis else ends


def paint(
    floor: regions.Region,
    walls: regions.Region,
    gaps: regions.Region,
    envelope: int,
    furniture: Sequence[regions.Rectangle] = (),
) -> Grid:
    """Paints the grid of a home from rectangles of floor, inner walls, gaps and furniture, which is
    wall too, with an envelope of so many cm.

    Returns the coordinates of the lines, xs and ys, and the states of the cells,
    (len(ys) - 1, len(xs) - 1) with row 0 at the bottom.
    """
    layers = [
        ((x0 - envelope, y0 - envelope, x1 + envelope, y1 + envelope), WALL)
        for x0, y0, x1, y1 in floor
    ]
    layers += (
        [(r, INDOORS) for r in floor] + [(r, WALL) for r in walls] + [(r, INDOORS) for r in gaps]
    )
    layers += [(r, WALL) for r in furniture]
    xs = sorted({x for r, _ in layers for x in r[::2]})
    ys = sorted({y for r, _ in layers for y in r[1::2]})
    column, row = ({line: k for k, line in enumerate(lines)} for lines in (xs, ys))
    cells = np.zeros((len(ys) - 1, len(xs) - 1), np.int8)
    for (x0, y0, x1, y1), state in layers:
        cells[row[y0] : row[y1], column[x0] : column[x1]] = state
    return np.array(xs), np.array(ys), cells


def _faces(lines, along, cells, beside) -> np.ndarray:
    """Returns the longest segments between rows with a wall on one side and the state `beside` on
    the other: (n, 2, 2) of (along, line).

    A face with the wall above it is never joined to one with the wall below it.
    """
    padded = np.pad(cells, ((1, 1), (0, 0)))
    low, high = padded[:-1], padded[1:]
    sides = ((low == beside) & (high == WALL)).astype(np.int8) - ((low == WALL) & (high == beside))
    edges = np.pad(sides, ((0, 0), (1, 1)))
    changes = edges[:, 1:] != edges[:, :-1]
    row, start = np.nonzero(changes & (edges[:, 1:] != 0))
    _, end = np.nonzero(changes & (edges[:, :-1] != 0))
    return np.stack(
        [np.stack([along[start], lines[row]], -1), np.stack([along[end], lines[row]], -1)], 1
    )


def segments(xs: np.ndarray, ys: np.ndarray, cells: np.ndarray, beside: int) -> np.ndarray:
    """Returns all segments (n, 2, 2) of (x, y) between walls and cells in the state `beside`.
    Collinear ones are joined.
    """
    level = _faces(ys, xs, cells, beside)
    upright = _faces(xs, ys, cells.T, beside)[..., ::-1]
    return np.concatenate([level, upright])


def are_indoors(grid: Grid, xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
    """Returns whether each point of a lattice, xs (W,) and ys (H,), is indoors: (H, W) bool."""
    lines_x, lines_y, cells = grid
    columns, rows = (
        np.searchsorted(lines, points, "right") - 1
        for lines, points in ((lines_x, xs), (lines_y, ys))
    )
    return np.pad(cells, ((0, 1), (0, 1)))[rows[:, None], columns] == INDOORS


def areas(grid: Grid, parts: Sequence[regions.Region]) -> list[float]:
    """Returns the indoor area in m2 of each region, `parts`, of a painted grid."""
    xs, ys, cells = grid
    indoors = np.outer(np.diff(ys), np.diff(xs)) * (cells == INDOORS)
    square_metres = []
    for part in parts:
        boxes = [(np.searchsorted(ys, r[1::2]), np.searchsorted(xs, r[::2])) for r in part]
        total = sum(int(indoors[slice(*rows), slice(*columns)].sum()) for rows, columns in boxes)
        square_metres.append(total / 10_000)
    return square_metres


def light(region: regions.Region, inside: np.ndarray) -> tuple[int, int]:
    """Returns the place of a room's light: its centroid if that is clear of walls, else the centre
    of its widest rectangle.

    `inside` has the segments (n, 2, 2) indoors, all along an axis.
    """
    total = 2 * regions.area(region)
    x = sum((x1 - x0) * (y1 - y0) * (x0 + x1) for x0, y0, x1, y1 in region) // total
    y = sum((x1 - x0) * (y1 - y0) * (y0 + y1) for x0, y0, x1, y1 in region) // total
    apart = np.maximum(inside.min(1) - (x, y), (x, y) - inside.max(1)).max(-1).min()
    if apart >= CLEAR and any(x0 <= x <= x1 and y0 <= y <= y1 for x0, y0, x1, y1 in region):
        return x, y
    x0, y0, x1, y1 = regions.widest(region)
    return (x0 + x1) // 2, (y0 + y1) // 2


def slanted(
    inside: np.ndarray,
    outside: np.ndarray,
    xs: np.ndarray,
    ys: np.ndarray,
    cells: np.ndarray,
    thickness: int,
    generator: PortableGenerator,
) -> tuple[np.ndarray, np.ndarray, list]:
    """Cuts off one outer corner of a home at 45 degrees. Returns the new segments inside and
    outside, and the triangle that was cut off.

    Both faces of the envelope are cut, so it stays `thickness` thick to a centimetre. The first
    corner of the triangle is the old corner. The triangle is empty, and nothing is cut, if the
    walls there are too short.
    """
    outdoors = np.pad(cells == OUTDOORS, 1, constant_values=True)
    around = (
        outdoors[:-1, :-1].astype(int) + outdoors[1:, :-1] + outdoors[:-1, 1:] + outdoors[1:, 1:]
    )
    corners = [
        (int(xs[j]), int(ys[i]))
        + tuple(int(outdoors[i + k, j + l]) for k in (0, 1) for l in (0, 1))
        for i, j in zip(*np.nonzero(around == 3))
    ]
    x, y, *quadrants = corners[generator.below(len(corners))]
    k, l = divmod(quadrants.index(0), 2)  # the quadrant that is wall
    right, up = 2 * l - 1, 2 * k - 1
    inner = x + right * thickness, y + up * thickness
    leg = min([LONGEST, *(_reach(inside, inner)[axis] // 2 for axis in (0, 1))]) // 5 * 5
    if leg < SHORTEST:
        return inside, outside, []
    outer_leg = leg + thickness * 586 // 1000  # 2 - sqrt 2
    triangle = [inner, (inner[0] + right * leg, inner[1]), (inner[0], inner[1] + up * leg)]
    return (
        _chamfered(inside, inner, right * leg, up * leg),
        _chamfered(outside, (x, y), right * outer_leg, up * outer_leg),
        triangle,
    )


def _reach(lines, corner) -> np.ndarray:
    """Returns the lengths along x and y of the segments that end in a corner."""
    return np.abs(lines[(lines == corner).all(-1).any(-1)] - corner).max((0, 1))


def cut_off(lines: np.ndarray, triangle: list) -> np.ndarray:
    """Cuts the triangle of a slanted corner off the segments (n, 2, 2) indoors."""
    corner, (x, _), (_, y) = triangle
    return _chamfered(lines, corner, x - corner[0], y - corner[1])


def _chamfered(lines, corner, dx, dy) -> np.ndarray:
    """Cuts back the two segments that end in a corner by (dx, dy), and adds one between their new
    ends.
    """
    x, y = corner
    lines = lines.copy()
    for line in lines:
        for end, other in ((0, 1), (1, 0)):
            if tuple(line[end]) == corner:
                line[end] += (dx, 0) if line[other][1] == y else (0, dy)
    return np.concatenate([lines, [[(x + dx, y), (x, y + dy)]]])


def holds(region: regions.Region, triangle: list) -> bool:
    """Returns True if the triangle's first corner is a corner of one of the region's rectangles."""
    return bool(triangle) and any(
        triangle[0] in ((x0, y0), (x1, y0), (x1, y1), (x0, y1)) for x0, y0, x1, y1 in region
    )
