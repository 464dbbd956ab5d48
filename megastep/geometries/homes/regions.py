"""Rectilinear regions: lists of disjoint rectangles (x0, y0, x1, y1), integer centimetres.

The rectangles of a region lie side by side: each is as tall as the region is there. `footprint`
makes such regions, and cuts preserve this. Axis 0 is x, axis 1 is y.
"""

Rectangle = tuple[int, int, int, int]
Region = list[Rectangle]

LATTICE = 5  # centimetres; cuts are at multiples


def area(region: Region) -> int:
    """Returns the area in cm2."""
    return sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in region)


def bounds(region: Region) -> tuple[int, int, int, int]:
    """Returns the bounding box (x0, y0, x1, y1)."""
    x0, y0, x1, y1 = zip(*region)
    return min(x0), min(y0), max(x1), max(y1)


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
    """Cuts the region across an axis at all its lines. Returns a list of (low, high, length
    across).
    """
    if len(region) == 1:
        r = region[0]
        return [(r[axis], r[axis + 2], r[3 - axis] - r[1 - axis])]
    lines = sorted({line for r in region for line in r[axis::2]})
    return [
        (
            low,
            high,
            sum(
                r[3 - axis] - r[1 - axis] for r in region if r[axis] <= low and r[axis + 2] >= high
            ),
        )
        for low, high in zip(lines, lines[1:])
    ]


def position(slices: list[tuple[int, int, int]], area_below: int) -> int:
    """Returns the lattice line that has nearly `area_below` cm2 of a region's `bands` below it."""
    for low, high, length in slices:
        if area_below <= (high - low) * length:
            break
        area_below -= (high - low) * length
    return (low + area_below // max(length, 1) + LATTICE // 2) // LATTICE * LATTICE


def corners(region: Region, axis: int) -> dict[int, int]:
    """Returns {line: side} of the lines through the region's inner corners. The outside is on side
    -1 (below) or +1 (above).
    """
    if len(region) == 1:
        return {}
    low, high = bounds(region)[axis::2]
    lengths = {}
    for r in region:
        for line, side in (r[axis], 1), (r[axis + 2], -1):
            below, above = lengths.get(line, (0, 0))
            length = r[3 - axis] - r[1 - axis]
            lengths[line] = (below + length, above) if side < 0 else (below, above + length)
    return {
        line: 1 if above < below else -1
        for line, (below, above) in lengths.items()
        if low < line < high
    }


def connected(region: Region, portal: int) -> bool:
    """Returns True if contacts of at least `portal` cm connect the whole region."""
    if len(region) == 1:
        return True
    reached, rest = [region[0]], list(region[1:])
    for a in reached:
        near = [
            b
            for b in rest
            if (a[2] == b[0] or b[2] == a[0]) and min(a[3], b[3]) - max(a[1], b[1]) >= portal
        ]
        reached += near
        rest = [b for b in rest if b not in near]
    return not rest


def widest(region: Region) -> tuple[int, int, int, int]:
    """Returns the rectangle in a region with the longest short side; of equal ones, the largest."""
    best = max(region, key=_breadth)
    ordered = sorted(region)
    for i, (x0, y0, x1, y1) in enumerate(ordered):
        for other in ordered[i + 1 :]:
            if other[0] == x1 and min(y1, other[3]) > max(y0, other[1]):
                x1, y0, y1 = other[2], max(y0, other[1]), min(y1, other[3])
                best = max(best, (x0, y0, x1, y1), key=_breadth)
    return best


def _breadth(rectangle) -> tuple[int, int]:
    x0, y0, x1, y1 = rectangle
    return min(x1 - x0, y1 - y0), (x1 - x0) * (y1 - y0)
