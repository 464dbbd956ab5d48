"""What a home is to hold, and the outline it gets: rooms with areas, and a rectilinear footprint.

The numbers are calibrated on real homes: CubiCasa5k (Kalervo et al. 2019), the room graphs of
CubiGraph5K (Lu et al. 2021) and the annotations of Raster-to-Vector (Liu et al. 2017). Lengths are
integer centimetres, areas cm2.
"""

from math import sqrt
from typing import NamedTuple

from megastep.geometries.homes import regions
from megastep.geometries.homes.portable_generator import PortableGenerator


class Kind(NamedTuple):
    """A kind of room: median and log standard deviation of its area in m2, minimum clear width in
    cm, how often it is added.
    """

    median: float
    sigma: float
    width: int
    weight: float = 0.0
    aspect: float = 2.6


KINDS = {
    "living": Kind(17.0, 0.30, 280),
    "bath": Kind(3.1, 0.28, 115, 0.55),
    "entry": Kind(5.0, 0.38, 115, aspect=4.6),
    "bedroom": Kind(10.8, 0.18, 220, 1.0),
    "kitchen": Kind(9.5, 0.40, 190),
    "closet": Kind(2.2, 0.35, 90, 1.55),
    "storage": Kind(2.7, 0.50, 90, 0.75),
    "lobby": Kind(1.2, 0.25, 90, 0.45),
    "utility": Kind(5.0, 0.50, 140, 0.45),
    "room": Kind(10.0, 0.35, 220, 0.55),
}
# What the first five rooms of every home are.
CORE = ("living", "bath", "entry", "bedroom", "kitchen")

MEDIAN_ROOMS, SIGMA_ROOMS, MIN_ROOMS, MAX_ROOMS = 8.3, 0.40, 3, 18
MEDIAN_ASPECT, SIGMA_ASPECT, MAX_ASPECT = 1.42, 0.24, 2.4
# of the areas: rooms that come out too small for their width are rejected, which favours large ones
SCALE = 0.78
FIT = 1.5  # no room is smaller than this many squares of its minimum width
ALLOWANCE = 12  # cm of a room's width that walls take
WALLS = 1.07  # walls take 7 % of a footprint
NOTCHES = (0.10, 0.38, 0.34, 0.18)  # how often an outline has 0, 1, 2 or 3 notches
AT_CORNER = 0.75  # of the notches; the others are bays in one side
MIN_NOTCH = 80  # cm per side
MIN_NECK = 220  # cm between two notches, or a notch and the side across
STEP = 10  # cm; the lattice of outlines


def room_count(stream: PortableGenerator) -> int:
    """How many rooms a home has."""
    count = int(stream.lognormal(MEDIAN_ROOMS, SIGMA_ROOMS) + 0.5)
    return min(max(count, MIN_ROOMS), MAX_ROOMS)


def programme(count: int, stream: PortableGenerator) -> list[tuple[str, int]]:
    """`count` rooms as a list of (kind, area in cm2)."""
    kinds = list(CORE[:count])
    most = {"bedroom": 1 + count // 4, "bath": 1 + count // 6, "lobby": 1, "utility": 1}
    while len(kinds) < count:
        allowed = [kind for kind in KINDS if kinds.count(kind) < most.get(kind, count)]
        kinds.append(allowed[stream.pick([KINDS[kind].weight for kind in allowed])])
    scale = 10_000 * stream.lognormal(SCALE, 0.15)
    drawn = [int(stream.lognormal(KINDS[kind].median, KINDS[kind].sigma) * scale) for kind in kinds]
    return [
        (kind, max(size, int(FIT * (KINDS[kind].width + ALLOWANCE) ** 2)))
        for kind, size in zip(kinds, drawn)
    ]


def _notch(width, height, share, at_corner, stream):
    """A rectangle of about `share` of the bounding box cut from a corner or from the middle of a
    side, or None.
    """
    ratio = stream.uniform(0.6, 1.7)
    across = int(sqrt(share * width * height * ratio)) // STEP * STEP
    down = int(sqrt(share * width * height / ratio)) // STEP * STEP
    if min(across, down) < MIN_NOTCH or across > width - MIN_NECK or down > height - MIN_NECK:
        return None
    left, low = stream.below(2) * (width - across), stream.below(2) * (height - down)
    if not at_corner:
        room = width - across - 2 * MIN_NECK
        if room < 0:
            return None
        left = MIN_NECK + stream.between(0, room // STEP) * STEP
    return left, low, left + across, low + down


def _apart(a, b):
    """The larger of the gaps along x and y between two rectangles, in cm."""
    return max(max(a[0], b[0]) - min(a[2], b[2]), max(a[1], b[1]) - min(a[3], b[3]))


def footprint(total: int, stream: PortableGenerator) -> regions.Region:
    """The inner outline, as a region, of a home whose rooms have `total` cm2: a box less up to
    three notches.
    """
    aspect = min(max(stream.lognormal(MEDIAN_ASPECT, SIGMA_ASPECT), 1.0), MAX_ASPECT)
    shares = [stream.uniform(0.03, 0.15) for _ in range(stream.pick(NOTCHES))]
    left = 1.0
    for share in shares:
        left -= share
    long = sqrt(total * WALLS / left * aspect)
    sides = [max(int(side) // STEP * STEP, MIN_NECK) for side in (long, long / aspect)]
    width, height = sides if stream.chance(0.5) else sides[::-1]

    notches = []
    for share in shares:
        at_corner = stream.chance(AT_CORNER)
        for _ in range(6):
            notch = _notch(width, height, share, at_corner, stream)
            if notch and all(_apart(notch, other) >= MIN_NECK for other in notches):
                notches.append(notch)
                break
    region = _without(width, height, notches)
    return (
        region
        if stream.chance(0.5)
        else _without(height, width, [(b, a, d, c) for a, b, c, d in notches])
    )


def _without(width, height, notches):
    """The box from (0, 0) less the notches, as a region."""
    lines = sorted({0, width, *(x for notch in notches for x in (notch[0], notch[2]))})
    region = []
    for x0, x1 in zip(lines, lines[1:]):
        low = max([0, *(n[3] for n in notches if n[0] <= x0 and n[2] >= x1 and n[1] == 0)])
        high = min(
            [height, *(n[1] for n in notches if n[0] <= x0 and n[2] >= x1 and n[3] == height)]
        )
        if region and region[-1][1] == low and region[-1][3] == high:
            region[-1] = (region[-1][0], low, x1, high)
        else:
            region.append((x0, low, x1, high))
    assert regions.connected(region, MIN_NECK)
    return region
