"""The plan of a home: its rooms with their areas, its outline, a rectilinear footprint, and the
partition of that into rooms, by recursive guillotine cuts and by corridors between two rows of
rooms.

The numbers are calibrated on real homes: CubiCasa5k (Kalervo et al. 2019), the room graphs of
CubiGraph5K (Lu et al. 2021) and the annotations of Raster-to-Vector (Liu et al. 2017). Lengths are
integer centimetres, areas cm2.
"""

from collections.abc import Sequence
from itertools import accumulate
from math import sqrt
from typing import NamedTuple

from megastep.geometries.homes import regions
from megastep.geometries.homes.portable_generator import PortableGenerator, exp

DENSEST = 3  # density at which homes have about three times as many walls as at 1
# Pieces tried per m2: in homes of density 1 with a clutter of 1, in the densest homes without
# clutter, and in the densest with a clutter of 1, where fewer are refused.
SPARSE, FULL, CLUTTERED = 0.4, 0.8, 0.38


class Style(NamedTuple):
    """How homes of a density and a clutter differ from others."""

    rooms: float  # factor of the median number of rooms
    sigma: float  # factor of the standard deviation of its logarithm
    max_rooms: int
    corridor: tuple[int, int]  # cm of clear width
    narrow: float  # how far small widths of doors are preferred, up to 1
    open_plan: float  # factor of the probability that a connection has no door
    furniture: float  # pieces tried per m2
    off_centre: float  # fraction of lights that are anywhere in their room
    clutter: float  # fraction of furniture that leaves narrow gaps
    half_blocked: float  # fraction of doorways with a narrow way in


def style(density: float, clutter: float = 0.0) -> Style:
    """Returns the style of a density, from 1 to `DENSEST`, and a clutter from 0 to 1."""
    t = (density - 1) / (DENSEST - 1)
    return Style(
        rooms=1 + 0.55 * t,
        sigma=1 - 0.3 * t,
        max_rooms=18 + int(2 * t),
        corridor=(110 - int(20 * t), 150 - int(40 * t)),
        narrow=t,
        open_plan=1 - 0.7 * t,
        furniture=SPARSE * clutter * (1 - t) + (FULL + (CLUTTERED - FULL) * clutter) * t,
        off_centre=0.7 * t,
        clutter=0.8 * clutter,
        half_blocked=0.25 * clutter,
    )


class Kind(NamedTuple):
    """A kind of room. Those that are close in order tend to be neighbours: dry rooms at the ends,
    entry and wet rooms in between.
    """

    median: float  # of the area, m2
    sigma: float  # standard deviation of the area's logarithm
    width: int  # minimum clear width, cm
    order: float
    weight: float = 0.0  # relative probability among rooms that are added
    aspect: float = 2.6  # maximum of long side / short side


KINDS = {
    "living": Kind(17.0, 0.30, 280, 0.0),
    "bath": Kind(3.1, 0.28, 115, 2.8, 0.55),
    "entry": Kind(5.0, 0.38, 115, 2.0, aspect=4.6),
    "bedroom": Kind(10.8, 0.18, 220, 4.0, 1.0),
    "kitchen": Kind(9.5, 0.40, 190, 1.0),
    "closet": Kind(2.2, 0.35, 90, 3.6, 1.55),
    "storage": Kind(2.7, 0.50, 90, 2.4, 0.75),
    "lobby": Kind(1.2, 0.25, 90, 2.1, 0.45),
    "utility": Kind(5.0, 0.50, 140, 2.6, 0.45),
    "room": Kind(10.0, 0.35, 220, 1.2, 0.55),
}
# The first five rooms of every home.
CORE = ("living", "bath", "entry", "bedroom", "kitchen")

MEDIAN_ROOMS, SIGMA_ROOMS, MIN_ROOMS = 8.3, 0.40, 3
MEDIAN_ASPECT, SIGMA_ASPECT, MAX_ASPECT = 1.42, 0.24, 2.4
# Factor of all areas. Rooms that are too narrow are rejected, which favours large ones.
SCALE = 0.78
FIT = 1.5  # minimum area of a room, in squares of its minimum width
ALLOWANCE = 12  # cm of a room's width that walls take
WALLS = 1.07  # walls take 7 % of a footprint
NOTCHES = (0.10, 0.38, 0.34, 0.18)  # probability of 0, 1, 2 or 3 notches in an outline
AT_CORNER = 0.75  # fraction of notches at a corner; the others are bays in one side
MIN_NOTCH = 80  # cm per side
MIN_NECK = 220  # cm between two notches, or a notch and the side across
STEP = 10  # cm; the lattice of outlines


def room_count(generator: PortableGenerator, style: Style) -> int:
    count = int(generator.lognormal(MEDIAN_ROOMS * style.rooms, SIGMA_ROOMS * style.sigma) + 0.5)
    return min(max(count, MIN_ROOMS), style.max_rooms)


def programme(count: int, generator: PortableGenerator) -> list[tuple[str, int]]:
    """Draws `count` rooms: a list of (kind, area in cm2)."""
    kinds: list[str] = [*CORE[:count]]
    maximum = {"bedroom": 1 + count // 4, "bath": 1 + count // 6, "lobby": 1, "utility": 1}
    while len(kinds) < count:
        allowed = [kind for kind in KINDS if kinds.count(kind) < maximum.get(kind, count)]
        kinds.append(allowed[generator.pick(KINDS[kind].weight for kind in allowed)])
    scale = 10_000 * generator.lognormal(SCALE, 0.15)
    rooms = []
    for kind in kinds:
        size = int(generator.lognormal(KINDS[kind].median, KINDS[kind].sigma) * scale)
        rooms.append((kind, max(size, int(FIT * (KINDS[kind].width + ALLOWANCE) ** 2))))
    return rooms


def _notch(width, height, fraction, at_corner, generator) -> regions.Rectangle | None:
    """Draws a rectangle of about `fraction` of the box, at a corner or side; None if none fits."""
    ratio = generator.uniform(0.6, 1.7)
    across = int(sqrt(fraction * width * height * ratio)) // STEP * STEP
    down = int(sqrt(fraction * width * height / ratio)) // STEP * STEP
    if min(across, down) < MIN_NOTCH or across > width - MIN_NECK or down > height - MIN_NECK:
        return None
    left, low = generator.below(2) * (width - across), generator.below(2) * (height - down)
    if not at_corner:
        most = width - across - MIN_NECK
        if most < MIN_NECK:
            return None
        left = generator.between(MIN_NECK, most, STEP)
    return left, low, left + across, low + down


def _apart(a, b) -> int:
    """Returns the larger of the gaps along x and y between two rectangles, in cm."""
    return max(max(a[0], b[0]) - min(a[2], b[2]), max(a[1], b[1]) - min(a[3], b[3]))


def footprint(total: int, generator: PortableGenerator) -> regions.Region:
    """Draws the inner outline of a home with `total` cm2 of rooms: a box less some notches."""
    aspect = min(max(generator.lognormal(MEDIAN_ASPECT, SIGMA_ASPECT), 1.0), MAX_ASPECT)
    fractions = [generator.uniform(0.03, 0.15) for _ in range(generator.pick(NOTCHES))]
    left = 1.0
    for fraction in fractions:
        left -= fraction
    long = sqrt(total * WALLS / left * aspect)
    sides = [max(int(side) // STEP * STEP, MIN_NECK) for side in (long, long / aspect)]
    width, height = sides if generator.chance(0.5) else sides[::-1]

    notches = []
    for fraction in fractions:
        at_corner = generator.chance(AT_CORNER)
        for _ in range(6):
            notch = _notch(width, height, fraction, at_corner, generator)
            if notch and all(_apart(notch, other) >= MIN_NECK for other in notches):
                notches.append(notch)
                break
    if not generator.chance(0.5):
        width, height, notches = height, width, [(b, a, d, c) for a, b, c, d in notches]
    lines = sorted({0, width, *(x for notch in notches for x in notch[::2])})
    region: regions.Region = []
    for x0, x1 in zip(lines, lines[1:]):
        beside = [n for n in notches if n[0] <= x0 and n[2] >= x1]
        low = max([0, *(n[3] for n in beside if n[1] == 0)])
        high = min([height, *(n[1] for n in beside if n[3] == height)])
        if region and region[-1][1::2] == (low, high):
            region[-1] = (region[-1][0], low, x1, high)
        else:
            region.append((x0, low, x1, high))
    return region


# ---- Partition ----

PORTAL = 120  # cm; the minimum neck between the parts of a region that is still to be cut
MIN_FILL = 0.55  # fraction of its bounding box that a room fills at least
MIN_JOG = 35  # cm; shorter steps in a room's outline are refused
SNAP = 45  # cm within which a cut moves to a corner of the outline
TEMPERATURE = 0.35  # of the random choice among cuts by their worst aspect
BRANCHES = 4  # cuts tried for one region
STEPS = 40  # cuts tried for a whole partition
MAX_CORRIDOR = 850  # cm of length
CORRIDORS = 8.0  # relative probability of a corridor against a simple cut of its aspect


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
    """Lays out rooms, (kind, area in cm2) each, in a region. Returns ([Room], {(axis, at): side of
    a cut on which the wall stands}), or None if none is found in STEPS cuts.
    """
    keys = [KINDS[kind].order + generator.normal(0.0, 0.8) for kind, _ in rooms]
    ordered = [rooms[i] for _, i in sorted(zip(keys, range(len(rooms))))]
    return _divide(region, ordered, generator, style.corridor, steps_left=[STEPS])


def _divide(region, rooms, generator, corridor, steps_left) -> tuple[list[Room], dict] | None:
    """Returns the result of `partition` for rooms in this order; counts `steps_left` down."""
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
    """Returns long side / short side of a region for rooms, or None if it does not suit them."""
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
