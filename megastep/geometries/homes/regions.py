"""Rectilinear regions: lists of disjoint rectangles (x0, y0, x1, y1), integer centimetres.

The rectangles of a region lie side by side: each is as tall as the region is there. `footprint`
makes such regions, and cuts preserve this. Axis 0 is x, axis 1 is y.
"""

Rectangle = tuple[int, int, int, int]
Region = list[Rectangle]

LATTICE = 5  # centimetres; cuts are at multiples


def area(region: Region) -> int:
    return sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in region)


def bounds(region: Region) -> Rectangle:
    x0, y0, x1, y1 = zip(*region)
    return min(x0), min(y0), max(x1), max(y1)


def breadth(rectangle: Rectangle) -> tuple[int, int]:
    """Returns the short side and the area, by which rectangles are compared."""
    x0, y0, x1, y1 = rectangle
    return min(x1 - x0, y1 - y0), (x1 - x0) * (y1 - y0)


def cut(region: Region, axis: int, at: int) -> tuple[Region, Region]:
    """Returns the parts of a region below and above a line."""
    lower, upper = [], []
    for rectangle in region:
        if rectangle[axis + 2] <= at:
            lower.append(rectangle)
        elif rectangle[axis] >= at:
            upper.append(rectangle)
        else:
            x0, y0, x1, y1 = rectangle
            lower.append((x0, y0, at, y1) if axis == 0 else (x0, y0, x1, at))
            upper.append((at, y0, x1, y1) if axis == 0 else (x0, at, x1, y1))
    return lower, upper


def bands(region: Region, axis: int) -> list[tuple[int, int, int]]:
    """Cuts the region across an axis at all its lines into (low, high, length across)."""
    if len(region) == 1:
        r = region[0]
        return [(r[axis], r[axis + 2], r[3 - axis] - r[1 - axis])]
    lines = sorted({line for r in region for line in r[axis::2]})
    lengths = [
        sum(r[3 - axis] - r[1 - axis] for r in region if r[axis] <= low and r[axis + 2] >= high)
        for low, high in zip(lines, lines[1:])
    ]
    return list(zip(lines, lines[1:], lengths))


def position(slices: list[tuple[int, int, int]], area_below: int) -> int:
    """Returns the lattice line that has nearly `area_below` cm2 of a region's `bands` below it."""
    for low, high, length in slices:
        if area_below <= (high - low) * length:
            break
        area_below -= (high - low) * length
    return (low + area_below // max(length, 1) + LATTICE // 2) // LATTICE * LATTICE


def corners(region: Region, axis: int) -> dict[int, int]:
    """Returns {line: outside's side, -1 (below) or +1} of lines through the inner corners."""
    if len(region) == 1:
        return {}
    low, high = bounds(region)[axis::2]
    excess: dict[int, int] = {}  # of the length that begins at a line over that which ends there
    for r in region:
        length = r[3 - axis] - r[1 - axis]
        excess[r[axis]] = excess.get(r[axis], 0) + length
        excess[r[axis + 2]] = excess.get(r[axis + 2], 0) - length
    return {line: 1 if more < 0 else -1 for line, more in excess.items() if low < line < high}


def connected(region: Region, portal: int) -> bool:
    """True if contacts of at least `portal` cm connect the whole region."""
    reached, rest = region[:1], region[1:]
    for a in reached:
        near = [
            b
            for b in rest
            if (a[2] == b[0] or b[2] == a[0]) and min(a[3], b[3]) - max(a[1], b[1]) >= portal
        ]
        reached += near
        rest = [b for b in rest if b not in near]
    return not rest


def widest(region: Region) -> Rectangle:
    """Returns the rectangle in a region with the longest short side; of equal ones, the largest."""
    best = max(region, key=breadth)
    ordered = sorted(region)
    for i, (x0, y0, x1, y1) in enumerate(ordered):
        for other in ordered[i + 1 :]:
            if other[0] == x1 and min(y1, other[3]) > max(y0, other[1]):
                x1, y0, y1 = other[2], max(y0, other[1]), min(y1, other[3])
                best = max(best, (x0, y0, x1, y1), key=breadth)
    return best
