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
    half = thickness // 2
    around = {0: (half, thickness - half), 1: (0, thickness), -1: (thickness, 0)}
    return lambda contact: around[sides.get((contact.axis, contact.at), 0)]


def _rectangle(contact, depth, low, high) -> regions.Rectangle:
    """Returns the rectangle of a contact's wall from low to high."""
    before, after = depth(contact)
    at = contact.at
    if contact.axis == 0:
        return at - before, low, at + after, high
    return low, at - before, high, at + after


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
        rectangles.append(_rectangle(contact, depth, low, high))
    return rectangles


def gap(opening: Opening, depth: Callable) -> regions.Rectangle:
    """Returns the rectangle that an opening takes out of its wall."""
    return _rectangle(opening.contact, depth, opening.low, opening.high)


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
    """Returns the grid of a home from rectangles, furniture being wall, too, with an envelope of so
    many cm: the coordinates of its lines, xs and ys, and the states of its cells,
    (len(ys) - 1, len(xs) - 1) with row 0 at the bottom.
    """
    grown = [
        (x0 - envelope, y0 - envelope, x1 + envelope, y1 + envelope) for x0, y0, x1, y1 in floor
    ]
    kinds = (grown, WALL), (floor, INDOORS), (walls, WALL), (gaps, INDOORS), (furniture, WALL)
    layers = [(r, state) for rectangles, state in kinds for r in rectangles]
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
    return np.stack([np.stack([along[at], lines[row]], -1) for at in (start, end)], 1)


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
    columns = np.searchsorted(lines_x, xs, "right") - 1
    rows = np.searchsorted(lines_y, ys, "right") - 1
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
    """Returns the place of a room's light: its centroid if that is clear of `inside`, the segments
    (n, 2, 2) indoors, else the centre of its widest rectangle.
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
    grid: Grid,
    thickness: int,
    generator: PortableGenerator,
) -> tuple[np.ndarray, np.ndarray, list]:
    """Cuts off one outer corner of a home at 45 degrees, from both faces of the envelope. Returns
    the new segments inside and outside, and the triangle that was cut off, from the old corner on;
    it is empty, and nothing is cut, if the walls there are too short.
    """
    xs, ys, cells = grid
    outdoors = np.pad(cells == OUTDOORS, 1, constant_values=True).astype(int)
    around = np.stack(
        [outdoors[:-1, :-1], outdoors[:-1, 1:], outdoors[1:, :-1], outdoors[1:, 1:]], -1
    )
    corners = np.argwhere(around.sum(-1) == 3)
    i, j = corners[generator.below(len(corners))]
    k, l = divmod(around[i, j].argmin(), 2)  # the quadrant that is wall
    x, y, right, up = int(xs[j]), int(ys[i]), int(2 * l - 1), int(2 * k - 1)
    inner = x + right * thickness, y + up * thickness
    lines = inside[(inside == inner).all(-1).any(-1)]  # those that end in the corner
    leg = min(LONGEST, *(np.abs(lines - inner).max((0, 1)) // 2)) // 5 * 5
    if leg < SHORTEST:
        return inside, outside, []
    outer_leg = leg + thickness * 586 // 1000  # 2 - sqrt 2
    triangle = [inner, (inner[0] + right * leg, inner[1]), (inner[0], inner[1] + up * leg)]
    outer = [(x, y), (x + right * outer_leg, y), (x, y + up * outer_leg)]
    return cut_off(inside, triangle), cut_off(outside, outer), triangle


def cut_off(lines: np.ndarray, triangle: list) -> np.ndarray:
    """Cuts back the two segments that end in the triangle's first corner, and adds one between
    their new ends.
    """
    corner, (x, _), (_, y) = triangle
    lines = lines.copy()
    for line in lines:
        for end, other in ((0, 1), (1, 0)):
            if tuple(line[end]) == corner:
                line[end] = (x, corner[1]) if line[other][1] == corner[1] else (corner[0], y)
    return np.concatenate([lines, [triangle[1:]]])


def holds(region: regions.Region, triangle: list) -> bool:
    """True if the triangle's first corner is a corner of one of the region's rectangles."""
    return bool(triangle) and any(
        triangle[0] in ((x0, y0), (x1, y0), (x1, y1), (x0, y1)) for x0, y0, x1, y1 in region
    )
