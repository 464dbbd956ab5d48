"""Furniture of dense and cluttered homes: boxes and L-shapes, as solid as walls. Integer
centimetres.

Furniture never cuts a room in two: around each piece, grown up to the walls that it stands by, is a
free strip, in which whatever is at most as wide can go round it. The strip is `PASSAGE` wide, and
around clutter `TIGHT[0]`.
"""

from collections.abc import Sequence
from typing import Any

from megastep.geometries.homes import regions
from megastep.geometries.homes.plan import Style
from megastep.geometries.homes.portable_generator import PortableGenerator
from megastep.geometries.homes.regions import Rectangle
from megastep.geometries.homes.walls import CLEAR

PASSAGE = 65  # cm; 5 more than the narrowest door
SLIT = 20  # cm; nearer than this to a wall, a piece stands at it
SIZES = (30, 110)  # cm per side
AT_WALL = 0.55  # probability, along each axis, of standing at a wall
L_SHAPED = 0.35  # fraction of pieces without one of their corners
NOTCH = 15  # cm per side; the least that an L-shape lacks, and of which it consists
BESIDE_LIGHT = 25  # cm; so that no piece touches a light's cell of the masks
TRIES = 6  # places tried for a piece
TIGHT = (24, 46)  # cm; widths of the gaps that clutter leaves. An agent is 21.2 cm wide
DEEP, LONG = (30, 90), (30, 130)  # cm; sides of a piece of clutter
OFF_WALL = 0.5  # fraction of clutter that leaves a gap behind it


def overlap(a: Sequence[int], b: Sequence[int], apart: int = 0) -> bool:
    """True if two rectangles overlap, or are less than `apart` cm apart in x and in y."""
    return min(a[2], b[2]) + apart > max(a[0], b[0]) and min(a[3], b[3]) + apart > max(a[1], b[1])


def _floor(region, solids) -> Rectangle:
    """Returns a room's widest rectangle less the walls at its sides."""
    rectangle = regions.widest(region)
    sides = [*rectangle]
    for solid in solids:
        part = [*map(max, rectangle[:2], solid[:2]), *map(min, rectangle[2:], solid[2:])]
        if part[0] < part[2] and part[1] < part[3]:
            touched = [side for side in range(4) if part[side] == rectangle[side]]
            side = min(touched, key=lambda side: part[side % 2 + 2] - part[side % 2])
            sides[side] = (max if side < 2 else min)(sides[side], part[(side + 2) % 4])
    x0, y0, x1, y1 = sides
    return x0, y0, x1, y1


def place_light(
    region: regions.Region, solids: regions.Region, generator: PortableGenerator
) -> tuple[int, int]:
    """Draws a place for a room's light, anywhere in its widest rectangle that is clear of walls."""
    x0, y0, x1, y1 = _floor(region, solids)
    return generator.between(x0 + CLEAR, x1 - CLEAR), generator.between(y0 + CLEAR, y1 - CLEAR)


def _walled(region) -> list[bool]:
    """Returns for each side of a room's widest rectangle whether the room ends there all along."""
    rectangle, closed = regions.widest(region), []
    for side in range(4):
        beyond, axis, at = [*rectangle], side % 2, rectangle[side]
        beyond[axis], beyond[axis + 2] = (at - 1, at) if side < 2 else (at, at + 1)
        closed.append(not any(overlap(beyond, other) for other in region))
    return closed


def tight(generator: PortableGenerator) -> int:
    """Draws the width in cm of a gap that clutter leaves. The narrowest are rare."""
    return max(generator.between(*TIGHT), generator.between(*TIGHT))


def _place(
    low, high, size, is_walled, generator, passage=PASSAGE, off_wall=0.0
) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Returns (low, high) of a piece along an axis, and of what it fills; None if it blocks."""
    spare = high - low - size
    if spare < 0:
        return None
    at_wall = generator.chance(AT_WALL)
    before = generator.below(2) * spare if at_wall else generator.between(0, spare, 5)
    before = 0 if before < SLIT else spare if spare - before < SLIT else before
    if off_wall and spare >= 2 * passage and generator.chance(off_wall):
        before = min(max(before, passage), spare - passage)
    fills = before < passage, spare - before < passage
    if all(fills) or any(fill and not wall for fill, wall in zip(fills, is_walled)):
        return None
    at = low + before
    return (at, at + size), (low if fills[0] else at, high if fills[1] else at + size)


def _roomy(floor, is_walled, generator) -> tuple[Rectangle, Rectangle] | None:
    """Returns the rectangles of a piece with a passage around it, and of what it fills; or None."""
    x0, y0, x1, y1 = floor
    width, height = (generator.between(*SIZES, step=5) for _ in "xy")
    across = _place(x0, x1, width, is_walled[0::2], generator)
    down = _place(y0, y1, height, is_walled[1::2], generator)
    if not (across and down):
        return None
    ((a, c), (fill_a, fill_c)), ((b, d), (fill_b, fill_d)) = across, down
    return (a, b, c, d), (fill_a, fill_b, fill_c, fill_d)


def _turned(sides) -> Any:
    """Exchanges x and y of a rectangle, or of something else in the order of its sides."""
    return sides and (sides[1], sides[0], sides[3], sides[2])


def _cluttered(
    floor, is_walled, filled, keep_clear, doorway, gap, generator
) -> tuple[Rectangle, Rectangle] | None:
    """As `_roomy`, of a piece that leaves narrow gaps, in front of a `doorway` if given."""
    if doorway:
        turns = doorway[2] - doorway[0] < doorway[3] - doorway[1]
    else:
        turns = generator.below(2)
    if not turns:
        return _in_row(floor, is_walled, filled, keep_clear, doorway, gap, generator)
    filled, keep_clear = [*map(_turned, filled)], [*map(_turned, keep_clear)]
    sides = _turned(floor), _turned(is_walled), filled, keep_clear, _turned(doorway)
    rectangles = _in_row(*sides, gap, generator)
    return rectangles and (_turned(rectangles[0]), _turned(rectangles[1]))


def _in_row(
    floor, is_walled, filled, keep_clear, doorway, gap, generator
) -> tuple[Rectangle, Rectangle] | None:
    """Places a piece so that along x it takes a free interval, less narrow gaps."""
    x0, y0, x1, y1 = floor
    size = generator.between(*DEEP, step=5)
    if doorway:
        at, above = (doorway[0] + doorway[2]) // 2, doorway[1] >= y0
        b = y1 - size if above else y0
        fills = b, b + size
        if y1 - y0 - size < gap or not is_walled[3 if above else 1]:
            return None
    else:
        at = generator.between(x0, x1)
        down = _place(y0, y1, size, is_walled[1::2], generator, gap, OFF_WALL)
        if not down:
            return None
        (b, _), fills = down
    before = generator.below(2)
    a = x0 if is_walled[0] and not before else x0 + gap
    c = x1 if is_walled[2] and before else x1 - gap
    for others, apart in (keep_clear, 0), (filled, gap):
        for x_low, y_low, x_high, y_high in others:
            if min(fills[1], y_high) + apart > max(fills[0], y_low):
                if x_low > at:
                    c = min(c, x_low - apart, x1 - TIGHT[0])
                elif x_high < at:
                    a = max(a, x_high + apart, x0 + TIGHT[0])
                else:
                    return None
    length = generator.between(*LONG, step=5)
    if c - a - length >= gap:
        at_low = at - a < c - at if doorway else before
        a, c = (a, a + length) if at_low else (c - length, c)
    if c - a < LONG[0]:
        return None
    return (a, b, c, b + size), (a, fills[0], c, fills[1])


def furnish(
    region: regions.Region,
    solids: regions.Region,
    keep_clear: Sequence[Rectangle],
    doorways: Sequence[Rectangle],
    style: Style,
    generator: PortableGenerator,
) -> regions.Region:
    """Draws the furniture of a room between solid walls: disjoint rectangles, of which an L-shape
    has two, off what is to be kept clear. The style says how many pieces, and which fraction of
    them is clutter, which blocks parts of doorways. Those that find no place are left out.
    """
    is_walled, floor = _walled(region), _floor(region, solids)
    x0, y0, x1, y1 = floor
    count = int(style.furniture * (x1 - x0) * (y1 - y0) / 10_000 + generator.uniform())
    doorways = [doorway for doorway in doorways if overlap(doorway, floor, 1)]
    filled, pieces = [], []
    for _ in range(count):
        is_clutter = style.clutter > 0 and generator.chance(style.clutter)
        doorway = doorways.pop() if is_clutter and doorways else None
        for _ in range(TRIES):
            if is_clutter:
                passage = tight(generator)
                placed = _cluttered(
                    floor, is_walled, filled, keep_clear, doorway, passage, generator
                )
            else:
                passage, placed = PASSAGE, _roomy(floor, is_walled, generator)
            if not placed:
                continue
            box, fills = placed
            is_free = not any(overlap(fills, other, passage) for other in filled)
            if is_free and not any(overlap(fills, other) for other in keep_clear):
                filled.append(fills)
                # the corner that an L-shape lacks is away from walls, or it would be walled in
                right = 1 if fills[0] == x0 else 0 if fills[2] == x1 else generator.below(2)
                up = 1 if fills[1] == y0 else 0 if fills[3] == y1 else generator.below(2)
                pieces += _shape(box, right, up, generator)
                break
    return pieces


def _shape(box, right, up, generator) -> list[Rectangle]:
    """Returns the rectangles of a piece in a box: all of it, or an L without a corner."""
    a, b, c, d = box
    if min(c - a, d - b) < 3 * NOTCH or not generator.chance(L_SHAPED):
        return [box]
    wide, high = (generator.between(NOTCH, side - NOTCH, 5) for side in (c - a, d - b))
    x = c - wide if right else a + wide
    low, top = (b, d - high) if up else (b + high, d)
    left, end = (a, x) if right else (x, c)
    return [(a, low, c, top), (left, top, end, d) if up else (left, b, end, low)]
