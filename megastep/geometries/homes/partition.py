"""Partition of a footprint into rooms, by recursive guillotine cuts and by corridors between two
rows of rooms.
"""

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

from megastep.geometries.homes import regions
from megastep.geometries.homes.plan import ALLOWANCE, KINDS, Style
from megastep.geometries.homes.portable_generator import PortableGenerator, exp

PORTAL = 120  # cm; the minimum neck between the parts of a region that is still to be cut
MIN_FILL = 0.55  # fraction of its bounding box that a room fills at least
MIN_JOG = 35  # cm; shorter steps in a room's outline are refused
SNAP = 45  # cm within which a cut moves to a corner of the outline
TEMPERATURE = 0.35  # of the random choice among cuts by their worst aspect
BRANCHES = 4  # cuts tried for one region
STEPS = 40  # cuts tried for a whole partition
MAX_CORRIDOR = 850  # cm of length
CORRIDORS = 8.0  # relative probability of a corridor against a simple cut of its aspect

# Rooms that are close in this order tend to be neighbours: dry rooms at the ends, entry and wet
# rooms in between.
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
    region: regions.Region


class Cut(NamedTuple):
    """A cut of a region into parts, each for some of the rooms."""

    parts: list  # of (region, rooms)
    lines: list  # of (axis, at, side), side as in `regions.corners` or 0
    aspect: float  # the worst of the parts
    favour: float = 1.0  # relative probability among cuts of equal aspect


def partition(
    region: regions.Region,
    rooms: Sequence[tuple[str, int]],
    generator: PortableGenerator,
    style: Style,
) -> tuple[list[Room], dict] | None:
    """Lays out rooms, a list of (kind, area in cm2), in a region.

    Returns ([Room], {(axis, at): side}): the rooms, and for the line of each cut the side of it on
    which the wall stands; None if no partition is found in STEPS cuts.
    """
    keyed = [(ORDER[kind] + generator.normal(0.0, 0.8), i) for i, (kind, _) in enumerate(rooms)]
    ordered = [rooms[i] for _, i in sorted(keyed)]
    return _divide(region, ordered, generator, style.corridor, steps_left=[STEPS])


def _divide(region, rooms, generator, corridor, steps_left) -> tuple[list[Room], dict] | None:
    """Returns the result of `partition` for rooms in this order. `steps_left` counts down over the
    whole recursion.
    """
    if len(rooms) == 1:
        return [Room(rooms[0][0], region)], {}
    cuts = _cuts(region, rooms, generator, corridor)
    for _ in range(min(BRANCHES, len(cuts))):
        steps_left[0] -= 1
        if steps_left[0] < 0:
            return None
        weights = (c.favour * exp(-min(c.aspect, 5.0) / TEMPERATURE) for c in cuts)
        cut = cuts.pop(generator.pick(weights))
        placed, sides = [], {(axis, at): side for axis, at, side in cut.lines}
        for part, rooms_inside in cut.parts:
            result = _divide(part, rooms_inside, generator, corridor, steps_left)
            if result is None:
                break
            placed += result[0]
            sides.update(result[1])
        else:
            return placed, sides
    return None


def _cuts(region, rooms, generator, corridor) -> list[Cut]:
    """Returns all cuts of a region in two that suit its rooms, and cuts with a corridor."""
    widths = [KINDS[kind].width + ALLOWANCE for kind, _ in rooms]
    firsts, lasts = list(accumulate(widths, max)), list(accumulate(widths[::-1], max))[::-1]
    size, total = regions.area(region), sum(size for _, size in rooms)
    cuts = []
    for axis in (0, 1):
        inner, slices = regions.corners(region, axis), regions.bands(region, axis)
        low, high = slices[0][0], slices[-1][1]
        flipped = generator.chance(0.5)
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
        cuts.append(_corridor(region, rooms, axis, slices, generator, corridor))
    return [cut for cut in cuts if cut]


def _corridor(region, rooms, axis, slices, generator, widths) -> Cut | None:
    """Cuts a region into two rows of rooms with the entry as a corridor between."""
    entries = [room for room in rooms if room[0] == "entry"]
    in_rows = [room for room in rooms if room[0] != "entry"]
    if not entries or len(in_rows) < 4:
        return None
    lattice = regions.LATTICE
    width = generator.between(*widths) // lattice * lattice + ALLOWANCE // 2 * 2
    k = generator.between(2, len(in_rows) - 2)
    below, total = (sum(size for _, size in part) for part in (in_rows[:k], in_rows))
    middle = regions.position(slices, regions.area(region) * below // total)
    at = middle - width // 2 // lattice * lattice
    if not slices[0][0] < at < at + width < slices[-1][1]:
        return None
    lower, rest = regions.cut(region, axis, at)
    strip, upper = regions.cut(rest, axis, at + width)
    if len(strip) > 1 or strip[0][3 - axis] - strip[0][1 - axis] > MAX_CORRIDOR:
        return None
    pairs = [(lower, in_rows[:k]), (upper, in_rows[k:])]
    cut = _suitable_cut(pairs, [(axis, at, 0), (axis, at + width, 0)])
    return cut and cut._replace(parts=[*cut.parts, (strip, entries)], favour=CORRIDORS)


def _suitable_cut(pairs, lines) -> Cut | None:
    """Returns the Cut of these (region, rooms), or None if a part does not suit its rooms."""
    aspects = [1.0]
    for part, rooms in pairs:
        aspect = _aspect(part, [kind for kind, _ in rooms])
        if aspect is None:
            return None
        aspects.append(aspect)
    return Cut(pairs, lines, max(aspects))


def _aspect(region, kinds) -> float | None:
    """Returns long side / short side of a region for rooms, or None if it does not suit them: it
    is too narrow, or for one room too long or too jagged.
    """
    is_room = len(kinds) == 1
    if not region or not regions.connected(region, 90 if is_room else PORTAL):
        return None
    x0, y0, x1, y1 = regions.bounds(region)
    short, long = sorted((x1 - x0, y1 - y0))
    clear = short
    if is_room and (len(region) > 2 or long > KINDS[kinds[0]].aspect * short):
        return None
    if is_room and len(region) == 2:
        (_, a, p, b), (_, c, _, d) = sorted(region)
        jogs = [abs(a - c), abs(b - d), p - x0, x1 - p]
        if regions.area(region) < MIN_FILL * short * long or any(0 < jog < MIN_JOG for jog in jogs):
            return None
        crossings = [b - a, d - c, *(length for *_, length in regions.bands(region, 1))]
        if min(abs(a - c), abs(b - d)) > 0 or min(crossings) < 90 + ALLOWANCE:
            return None
        clear, _ = regions.breadth(regions.widest(region))
    return long / short if clear >= max(KINDS[k].width for k in kinds) + ALLOWANCE else None
