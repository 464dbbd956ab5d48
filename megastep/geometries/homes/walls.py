"""The walls of a home: contacts between rooms with their doors and openings, the solids of walls,
the segments that bound them, and lights. Integer centimetres.

Solids are painted on a grid with a line at each coordinate that occurs, so a cell is wholly
outdoors, wall or indoors.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from megastep.geometries.homes import regions
from megastep.geometries.homes.plan import Room, Style
from megastep.geometries.homes.portable_generator import PortableGenerator

# Probability of each width of a door.
DOORS = {60: 0.06, 65: 0.12, 70: 0.16, 75: 0.18, 80: 0.24, 85: 0.14, 90: 0.10}
SMALL = ("bath", "closet", "lobby", "storage")  # rooms with doors of at most 80 cm
MAX_SMALL = 80
STUB = 5  # cm of wall beside a door in a corner
IN_CORNER = 0.70  # fraction of doors in a corner; the others are anywhere
MIN_CONTACT = 95  # cm of clear wall that a door needs
LOOPS = 0.45  # fraction of cheap contacts outside the tree that become doors too
FULL = 0.45  # fraction of connections without a door that take the whole wall
OPENING = (100, 240)  # cm; width of the others
REACH = 25  # cm; a wall this close to the end of another leaves less of it to open


def _of_pairs(table) -> dict[frozenset, float]:
    return {frozenset(p.split()): value for value, ps in table.items() for p in ps.split(", ")}


# Probability that a connection of two kinds of rooms has no door.
OPEN = _of_pairs(
    {
        0.7: "living kitchen",
        0.6: "living entry, kitchen entry, living room, kitchen room",
        0.4: "entry room, entry lobby",
        0.2: "bedroom closet, entry closet, bedroom room",
    }
)
# Cost of a connection in the spanning tree: cheap ones become doors.
COSTS = _of_pairs(
    {
        0.05: "living kitchen",
        0.25: "bedroom closet",
        0.7: "bath living",
        0.8: "bath bedroom",
        1.5: "bedroom",
        2.0: "closet, closet storage, storage, closet bath, storage bath",
        3.0: "bath, bath kitchen",
    }
)
COST_ENTRY, COST_LIVING, COST = 0.15, 0.3, 1.0
CHEAP = 0.8  # the maximum cost of a loop


class Contact(NamedTuple):
    """A straight wall between rooms a and b, from low to high on the line `at` of `axis`."""

    axis: int
    at: int
    low: int
    high: int
    a: int
    b: int


class Opening(NamedTuple):
    """A gap in the wall of a contact, from low to high, with or without a door."""

    contact: Contact
    low: int
    high: int
    door: bool


def contacts(rooms: Sequence[Room]) -> list[Contact]:
    """Returns every Contact between two of the rooms. Collinear pieces are merged."""
    pieces = []
    for (i, room), (j, other) in combinations(enumerate(rooms), 2):
        for r in room.region:
            for s in other.region:
                for axis in (0, 1):
                    low, high = max(r[1 - axis], s[1 - axis]), min(r[3 - axis], s[3 - axis])
                    if low < high and (r[axis + 2] == s[axis] or s[axis + 2] == r[axis]):
                        at = r[axis + 2] if r[axis + 2] == s[axis] else r[axis]
                        pieces.append((i, j, axis, at, low, high))
    merged = []
    for i, j, axis, at, low, high in sorted(pieces):
        if merged and merged[-1] == (axis, at, merged[-1].low, low, i, j):
            merged[-1] = merged[-1]._replace(high=high)
        else:
            merged.append(Contact(axis, at, low, high, i, j))
    return merged


def clear(contact: Contact, others: Iterable[Contact], depth: Callable) -> tuple[int, int]:
    """Returns the part (low, high) of a contact that no other wall meets."""
    low, high = contact.low, contact.high
    for other in others:
        if other.axis != contact.axis and other.low - REACH <= contact.at <= other.high + REACH:
            before, after = depth(other)
            if abs(other.at - contact.low) <= REACH:
                low = max(low, other.at + after)
            elif abs(other.at - contact.high) <= REACH:
                high = min(high, other.at - before)
    return low, high


def _cost(*kinds) -> float:
    other = COST_ENTRY if "entry" in kinds else COST_LIVING if "living" in kinds else COST
    return COSTS.get(frozenset(kinds), other)


def connections(
    rooms: Sequence[Room], spans: dict[Contact, tuple[int, int]], generator: PortableGenerator
) -> tuple[float, list[Contact]] | None:
    """Chooses the contacts to open, by their clear spans: a cheapest spanning tree of the rooms,
    and loops. Returns (mean cost of the tree, [contact]), None if no tree reaches all.
    """
    longest = {}
    for contact, (low, high) in spans.items():
        pair = contact.a, contact.b
        if high - low >= MIN_CONTACT and high - low > longest.get(pair, (0, None))[0]:
            longest[pair] = high - low, contact
    edges = sorted(
        (_cost(rooms[a].kind, rooms[b].kind) + generator.uniform(0, 0.15), contact)
        for (a, b), (_, contact) in longest.items()
    )
    parts = list(range(len(rooms)))
    tree, cheap, total = [], [], 0.0
    for cost, contact in edges:
        a, b = parts[contact.a], parts[contact.b]
        if a == b:
            cheap += [contact] if cost < CHEAP else []
            continue
        parts = [b if part == a else part for part in parts]
        tree.append(contact)
        total += cost
    if len(set(parts)) > 1:
        return None
    loops = [contact for contact in cheap if generator.chance(LOOPS)]
    return total / (len(rooms) - 1), tree + loops


def draw_opening(
    contact: Contact,
    span: tuple[int, int],
    kinds: tuple[str, str],
    generator: PortableGenerator,
    style: Style,
) -> Opening:
    """Draws an Opening within the clear span of a contact between rooms of two kinds."""
    low, high = span
    open_plan = generator.chance(OPEN.get(frozenset(kinds), 0.0) * style.open_plan)
    if open_plan:
        if generator.chance(FULL):
            return Opening(contact, low, high, False)
        width = generator.between(*OPENING, step=5)
    else:
        is_small = any(kind in SMALL for kind in kinds)
        widths = [width for width in DOORS if not is_small or width <= MAX_SMALL]
        weights = [DOORS[width] * (1 + style.narrow * (90 - width) ** 2 / 100) for width in widths]
        width = widths[generator.pick(weights)]
    spare = high - low - width - 2 * STUB
    if spare < 0:
        return Opening(contact, low, high, False)
    in_corner = generator.chance(IN_CORNER)
    offset = generator.below(2) * spare if in_corner else generator.between(0, spare)
    return Opening(contact, low + STUB + offset, low + STUB + offset + width, not open_plan)


# ---- Solids ----

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
    the other: (n, 2, 2) of (along, line). Faces of different sides are not joined.
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
    """Returns the segments (n, 2, 2) of (x, y) between walls and cells of a state, joined."""
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
    """Cuts back the two segments at the triangle's first corner, and joins their new ends."""
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
