"""What every geometry must satisfy, whatever made it: generated homes, mazes, imported plans and
the files of `geometry=files`. `errors` says what one does not satisfy.

In this file a raster is (H, W) cells of a side of `cell` metres, with row 0 at the top.
"""

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict

FINE = 0.05  # metres per cell of the raster
MAX_FINE_CELLS = 2_250_000  # of the raster; a plan of 75 m x 75 m
RADIUS = 0.15 / 2**0.5  # metres; of an agent
SPAWN = 0.15  # metres; each room has a point this far from all walls
NEAR = 1e-3  # metres; points nearer than this are the same
PARALLEL = 1e-6  # sine of an angle below which two walls are parallel
LIMIT = 0.3  # metres; the largest clearance that is measured
CHUNK = 256  # walls compared with all others at a time


def clearance(g: dotdict, cell: float = FINE) -> np.ndarray:
    """Returns the metres, at most 0.3, from each cell's centre on a raster, of the masks' extent,
    to the nearest wall. `cell` divides the side of the cells of the masks.
    """
    ratio = round(g.res / cell)
    height, width = (n * ratio for n in g.masks.shape)
    distance = np.full((height, width), LIMIT)
    x, y = (np.arange(width) + 0.5) * cell, (height - np.arange(height) - 0.5) * cell
    # long slanted walls in pieces, as the box around each is measured
    n_pieces = np.ceil(np.abs(g.walls[:, 1] - g.walls[:, 0]).min(1) / 5).astype(int).clip(1)
    lines = (np.linspace(a, b, n + 1) for (a, b), n in zip(g.walls.astype(float), n_pieces))
    for (ax, ay), (bx, by) in (piece for line in lines for piece in zip(line, line[1:])):
        columns = slice(*np.searchsorted(x, (min(ax, bx) - LIMIT, max(ax, bx) + LIMIT)))
        rows = slice(*np.searchsorted(-y, (-max(ay, by) - LIMIT, -min(ay, by) + LIMIT)))
        px, py = x[None, columns] - ax, y[rows, None] - ay
        dx, dy = bx - ax, by - ay
        along = np.clip((px * dx + py * dy) / max(dx * dx + dy * dy, 1e-12), 0, 1)
        distance[rows, columns] = np.minimum(
            distance[rows, columns], np.hypot(px - along * dx, py - along * dy)
        )
    return distance


def joins(labels: np.ndarray, rooms: np.ndarray) -> bool:
    """True if one component of `labels` enters all `rooms`; both are 0 where there is none."""
    pairs = np.unique(np.stack([rooms, labels])[:, (rooms > 0) & (labels > 0)], axis=1)
    n_entered = np.bincount(pairs[1])
    return n_entered.max(initial=0) == len(np.unique(rooms[rooms > 0]))


def _sorted_ends(walls) -> np.ndarray:
    """Returns walls as rows (M, 4), from left to right, that are equal in either direction."""
    ends = walls.astype(np.float64)
    (x0, y0), (x1, y1) = ends[:, 0].T, ends[:, 1].T
    is_reversed = (x0 > x1) | (x0 == x1) & (y0 > y1)
    ends[is_reversed] = ends[is_reversed, ::-1]
    return ends[ends[:, 0, 0].argsort(kind="stable")].reshape(-1, 4)


def _crosses(ends) -> bool:
    """True if two walls cross inside both, or lie on one another for more than a point."""
    starts, stops = ends[:, 0] + 1j * ends[:, 1], ends[:, 2] + 1j * ends[:, 3]  # x + iy
    lengths = np.abs(stops - starts)
    units = (stops - starts) / lengths
    for low in range(0, len(ends), CHUNK):
        # of others, of which those further on begin further right, as walls of this chunk see them
        own = slice(low, low + CHUNK)
        others = slice(low, np.searchsorted(ends[:, 0], ends[own, 2].max() + NEAR))
        first = (starts[others] - starts[own, None]) * units[own, None].conj()
        way = units[others] * units[own, None].conj()
        is_parallel = np.abs(way.imag) < PARALLEL
        reach = -first.imag / np.where(is_parallel, 1, way.imag)  # on the other, to this one's line
        along = first.real + reach * way.real
        is_crossing = (along > NEAR) & (along < lengths[own, None] - NEAR) & ~is_parallel
        is_crossing &= (reach > NEAR) & (reach < lengths[others] - NEAR)
        last = first.real + way.real * lengths[others]
        shared = np.minimum(np.maximum(first.real, last), lengths[own, None])
        shared -= np.maximum(np.minimum(first.real, last), 0)
        is_overlap = is_parallel & (np.abs(first.imag) < NEAR) & (shared > NEAR)
        np.fill_diagonal(is_overlap, False)
        if (is_crossing | is_overlap).any():
            return True
    return False


def errors(g: dotdict, fine: float = FINE) -> list[str]:
    """Returns a sentence for each thing that a geometry does not satisfy, none if it is sound: it
    passes `geometry.validate_geometry`; no two walls are the same or cross; it is closed; an agent
    can reach every room from every other, on a raster of `fine` metres; and each light is indoors.
    """
    try:
        valid = geometry.validate_geometry(dotdict(g))
    except ValueError as error:
        return [str(error)]
    messages: list[str] = []
    if len(valid.walls) < len(g["walls"]):
        messages.append("a wall has no length")
    ends = _sorted_ends(valid.walls)
    if len(np.unique(ends, axis=0)) < len(ends):
        messages.append("two walls are the same")
    elif _crosses(ends):
        messages.append("two walls cross or overlap; split them where they meet")
    labels, _ = geometry.components(np.pad(valid.masks >= 0, 1, constant_values=True))
    if (valid.masks[labels[1:-1, 1:-1] == labels[0, 0]] > 0).any():
        messages.append("the envelope is open: a room leads outside")

    distance, rooms, cell = fine_rooms(valid, fine)
    is_room = rooms > 0
    cells = geometry.indices(valid.lights, distance.shape, cell)
    is_within = ((cells >= 0) & (cells < distance.shape)).all(1)
    lit = tuple(cells[is_within].T)
    labels, _ = geometry.components(distance > cell * 0.75)
    if not is_within.all() or (labels[lit] == labels[0, 0]).any():
        messages.append("a light is outdoors")
    is_reachable = distance > RADIUS - 1e-3
    labels, _ = geometry.components(is_reachable)
    if not joins(labels, rooms):
        messages.append("an agent cannot reach every room")
    if len(np.unique(labels[is_room & (distance >= SPAWN)])) > 1:
        messages.append("an agent cannot reach every point to spawn at")
    if len(np.unique(rooms[is_room])) > len(np.unique(rooms[is_room & (distance >= SPAWN)])):
        messages.append("a room has no point to spawn at")
    return messages


def fine_rooms(g: dotdict, fine: float = FINE) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns the clearance and the rooms of a geometry on a raster, and the side of its cells in
    metres: `fine`, more if the geometry is so large that the raster would have too many.
    """
    ratio = max(1, round(g.res / fine))
    while ratio > 1 and g.masks.size * ratio**2 > MAX_FINE_CELLS:
        ratio -= 1
    rooms = np.maximum(g.masks, 0).repeat(ratio, 0).repeat(ratio, 1)
    return clearance(g, cell=g.res / ratio), rooms, g.res / ratio
