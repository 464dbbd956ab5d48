"""Cuts a footprint into rooms: recursive guillotine cuts, and corridors between two rows of
rooms.
"""

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

from megastep.geometries.homes import regions
from megastep.geometries.homes.plan import ALLOWANCE, KINDS
from megastep.geometries.homes.portable_generator import PortableGenerator, exp

PORTAL = 120  # cm; the minimum neck between the parts of a region that is still to be cut
MIN_FILL = 0.55  # of a room's bounding box
MIN_JOG = 35  # cm; shorter steps in a room's outline are refused
SNAP = 45  # cm within which a cut moves to a corner of the outline
TEMPERATURE = 0.35  # of the choice among cuts by their worst aspect
BRANCHES = 4  # cuts tried at one place before giving it up
STEPS = 40  # cuts tried before a whole partition is given up
CORRIDOR = (110, 150)  # cm of clear width
MAX_CORRIDOR = 850  # cm
CORRIDORS = 8.0  # how much likelier a corridor is drawn than a simple cut of its aspect

# Rooms close in this order tend to be neighbours: dry rooms at the ends, entry and wet rooms in
# between.
ORDER = {
    "living": 0.0,
    "kitchen": 1.0,
    "room": 1.2,
    "entry": 2.0,
    "lobby": 2.1,
    "storage": 2.4,
    "utility": 2.6,
    "bath": 2.8,
    "closet": 3.6,
    "bedroom": 4.0,
}


class Room(NamedTuple):
    kind: str
    region: list


class Cut(NamedTuple):
    """Parts of a region and the rooms that go there, the lines between, and the worst aspect among
    the parts.
    """

    parts: list  # of (region, rooms)
    lines: list  # of (axis, at, side), side as in `regions.corners` or 0
    aspect: float
    favour: float = 1.0  # how much likelier it is drawn than another of its aspect


class Failure(Exception):
    """No partition was found in the steps allowed."""


def partition(
    region: regions.Region, rooms: Sequence[tuple[str, int]], stream: PortableGenerator
) -> tuple[list[Room], dict]:
    """Rooms, a list of (kind, area), laid out in a region.

    Returns ([Room], {(axis, at): side}), the second the side of each cut's line on which its wall
    is to stand. Raises Failure.
    """
    keyed = [(ORDER[kind] + stream.normal(0.0, 0.8), i) for i, (kind, _) in enumerate(rooms)]
    ordered = [rooms[i] for _, i in sorted(keyed)]
    steps = [STEPS]
    found = _divided(region, ordered, stream, steps)
    if found is None:
        raise Failure
    return found


def _divided(region, rooms, stream, steps):
    """As `partition`, for rooms in their order; None when it fails. `steps` counts down over the
    whole recursion.
    """
    if len(rooms) == 1:
        return [Room(rooms[0][0], region)], {}
    cuts = _cuts(region, rooms, stream)
    for _ in range(min(BRANCHES, len(cuts))):
        steps[0] -= 1
        if steps[0] < 0:
            return None
        cut = cuts.pop(
            stream.pick([c.favour * exp(-min(c.aspect, 5.0) / TEMPERATURE) for c in cuts])
        )
        placed, sides = [], {(axis, at): side for axis, at, side in cut.lines}
        for part, inside in cut.parts:
            found = _divided(part, inside, stream, steps)
            if found is None:
                break
            placed += found[0]
            sides.update(found[1])
        else:
            return placed, sides
    return None


def _cuts(region, rooms, stream):
    """All the cuts of a region in two that suit its rooms, and those with a corridor."""
    widths = [KINDS[kind].width + ALLOWANCE for kind, _ in rooms]
    firsts, lasts = list(accumulate(widths, max)), list(accumulate(widths[::-1], max))[::-1]
    size, total = regions.area(region), sum(size for _, size in rooms)
    cuts = []
    for axis in (0, 1):
        inner, slices = regions.corners(region, axis), regions.bands(region, axis)
        low, high = slices[0][0], slices[-1][1]
        flipped = stream.chance(0.5)
        below = 0
        for k in range(1, len(rooms)):
            below += rooms[k - 1][1]
            at = regions.position(slices, (total - below if flipped else below) * size // total)
            line = min(inner, key=lambda corner: abs(corner - at), default=at)
            side = 0
            if line in inner and abs(line - at) <= SNAP:
                at, side = line, inner[line]
            first, last = (high - at, at - low) if flipped else (at - low, high - at)
            if first >= firsts[k - 1] and last >= lasts[k]:
                lower, upper = regions.cut(region, axis, at)
                lower, upper = (upper, lower) if flipped else (lower, upper)
                pairs = [(lower, rooms[:k]), (upper, rooms[k:])]
                cuts.append(_suitable_cut(pairs, [(axis, at, side)]))
        cuts.append(_corridor(region, rooms, axis, slices, stream))
    return [cut for cut in cuts if cut]


def _corridor(region, rooms, axis, slices, stream):
    """A cut of a region into two rows of rooms with the entry as a corridor between them, or
    None.
    """
    entries = [room for room in rooms if room[0] == "entry"]
    others = [room for room in rooms if room[0] != "entry"]
    if not entries or len(others) < 4:
        return None
    low, high = slices[0][0], slices[-1][1]
    width = stream.between(*CORRIDOR) // regions.LATTICE * regions.LATTICE + ALLOWANCE // 2 * 2
    k = stream.between(2, len(others) - 2)
    below, total = (sum(size for _, size in part) for part in (others[:k], others))
    at = (
        regions.position(slices, regions.area(region) * below // total)
        - width // 2 // regions.LATTICE * regions.LATTICE
    )
    if not low < at < at + width < high:
        return None
    lower, rest = regions.cut(region, axis, at)
    strip, upper = regions.cut(rest, axis, at + width)
    if len(strip) > 1 or strip[0][3 - axis] - strip[0][1 - axis] > MAX_CORRIDOR:
        return None
    cut = _suitable_cut(
        [(lower, others[:k]), (upper, others[k:])], [(axis, at, 0), (axis, at + width, 0)]
    )
    return cut and cut._replace(parts=[*cut.parts, (strip, entries)], favour=CORRIDORS)


def _suitable_cut(pairs, lines):
    """The Cut of these (region, rooms), or None when a part does not suit its rooms."""
    worst = 1.0
    for part, rooms in pairs:
        aspect = _leaf_aspect(part, rooms[0][0]) if len(rooms) == 1 else _aspect(part, rooms)
        if aspect is None:
            return None
        worst = max(worst, aspect)
    return Cut(pairs, lines, worst)


def _aspect(region, rooms):
    """Long side by short side of a region for several rooms, or None when it is too narrow for one
    of them.
    """
    if not region or not regions.connected(region, PORTAL):
        return None
    x0, y0, x1, y1 = regions.bounds(region)
    short, long = sorted((x1 - x0, y1 - y0))
    if short < max(KINDS[kind].width for kind, _ in rooms) + ALLOWANCE:
        return None
    return long / short


def _leaf_aspect(region, kind):
    """Long side by short side of a room of this kind, or None when it cannot be one."""
    if not region or len(region) > 2 or not regions.connected(region, 90):
        return None
    x0, y0, x1, y1 = regions.bounds(region)
    short, long = sorted((x1 - x0, y1 - y0))
    if len(region) > 1:
        (_, a, p, b), (_, c, _, d) = sorted(region)
        jogs = [abs(a - c), abs(b - d), p - x0, x1 - p]
        if regions.area(region) < MIN_FILL * short * long or any(0 < jog < MIN_JOG for jog in jogs):
            return None
        if min(abs(a - c), abs(b - d)) > 0 or regions.narrowest(region) < 90 + ALLOWANCE:
            return None
        x0, y0, x1, y1 = regions.widest(region)
        clear = min(x1 - x0, y1 - y0)
    else:
        clear = short
    if clear < KINDS[kind].width + ALLOWANCE or long > KINDS[kind].aspect * short:
        return None
    return long / short
