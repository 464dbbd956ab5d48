"""Checks of a home, from its walls and masks, on a raster of 5 cm, or 2 cm of cluttered homes.
`make_homes.py` uses them.
"""

import numpy as np

from megastep import geometry

FINE = 0.05  # metres per cell
FINEST = 0.02  # of cluttered homes: a body 21 cm wide has so much to spare in a gap of 24 cm
RADIUS = 0.15 / 2**0.5  # metres; of an agent
GAP = 0.55  # metres; minimum width of a passage
SPAWN = 0.15  # metres; each room has a point this far from all walls
MAX_WALLS, MAX_EXTENT = 500, 40.0
LIT = 0.05  # metres; minimum distance of a light from a wall
MIN_CELLS = 4  # minimum cells of a room in the masks


def components(free):
    """Labels the 4-connected components of cells, (H, W) bool. Returns the labels, (H, W) integers
    with 0 where not free, and the number of components.
    """
    edges = np.diff(np.pad(free, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (row, start), end = np.nonzero(edges == 1), np.nonzero(edges == -1)[1]
    # the number of the first run of free cells in each row
    first = np.searchsorted(row, np.arange(len(free) + 1))
    parents = list(range(len(row)))

    def root(run):
        while parents[run] != run:
            parents[run] = run = parents[parents[run]]
        return run

    for i in range(1, len(free)):
        a, b = first[i - 1], first[i]
        while a < first[i] and b < first[i + 1]:
            if start[a] < end[b] and start[b] < end[a]:
                parents[root(b)] = root(a)
            a, b = (a + 1, b) if end[a] < end[b] else (a, b + 1)
    _, labels = np.unique([root(run) for run in range(len(row))], return_inverse=True)
    result = np.zeros(free.shape, int)
    result[free] = np.repeat(labels + 1, end - start)
    return result, labels.max(initial=-1) + 1


def clearance(g, limit=0.3, cell=FINE):
    """Returns the metres, at most `limit`, from each cell's centre on a fine raster to the nearest
    wall.
    """
    ratio = round(g.res / cell)
    height, width = g.masks.shape[0] * ratio, g.masks.shape[1] * ratio
    distance = np.full((height, width), limit)
    x, y = (np.arange(width) + 0.5) * cell, (height - np.arange(height) - 0.5) * cell
    for (ax, ay), (bx, by) in g.walls.astype(float):
        columns = slice(*np.searchsorted(x, (min(ax, bx) - limit, max(ax, bx) + limit)))
        rows = slice(*np.searchsorted(-y, (-max(ay, by) - limit, -min(ay, by) + limit)))
        px, py = x[None, columns] - ax, y[rows, None] - ay
        dx, dy = bx - ax, by - ay
        along = np.clip((px * dx + py * dy) / max(dx * dx + dy * dy, 1e-12), 0, 1)
        distance[rows, columns] = np.minimum(
            distance[rows, columns], np.hypot(px - along * dx, py - along * dy)
        )
    return distance


def _reaches(labels, rooms):
    """Returns True if one component enters all rooms 1..n."""
    by_room = [
        np.unique(labels[(rooms == room) & (labels > 0)]) for room in range(1, rooms.max() + 1)
    ]
    return any(all(label in labels_inside for labels_inside in by_room) for label in by_room[0])


def errors(g, is_cluttered=False):
    """Returns a sentence for each error in a home. In a cluttered one gaps may be as narrow as an
    agent.
    """
    messages, cell = [], FINEST if is_cluttered else FINE
    walls = g.walls.reshape(-1, 4)
    canonical = np.where(
        (walls[:, :2] > walls[:, 2:]).any(-1)[:, None] & (walls[:, 0] >= walls[:, 2])[:, None],
        walls[:, [2, 3, 0, 1]],
        walls,
    )
    if not np.isfinite(walls).all() or (walls[:, :2] == walls[:, 2:]).all(-1).any():
        messages.append("a wall is not finite or has no length")
    if len(np.unique(canonical, axis=0)) < len(walls):
        messages.append("two walls are the same")
    if np.abs(g.walls.min((0, 1)) - 1).max() > 1e-3 and g.n_outer:
        messages.append(f"coordinates start at {g.walls.min((0, 1))} and not at 1 m")
    if np.ptp(g.walls, axis=(0, 1)).max() > MAX_EXTENT or len(walls) > MAX_WALLS:
        messages.append("it is too large")

    rooms = g.masks.max()
    if min(np.bincount(g.masks[g.masks > 0], minlength=rooms + 1)[1:], default=0) < MIN_CELLS:
        messages.append("a room has too few cells")
    labels, _ = components(g.masks >= 0)
    if (g.masks[labels == labels[0, 0]] > 0).any():
        messages.append("the envelope is open")

    distance = clearance(g, cell=cell)
    ratio = round(g.res / cell)
    fine = np.maximum(g.masks, 0).repeat(ratio, 0).repeat(ratio, 1)
    discs = [(RADIUS, "an agent"), (GAP / 2, "a disc as wide as the narrowest gap")]
    for radius, disc in discs[: 1 if is_cluttered else 2]:
        if not _reaches(components(distance > radius - 1e-3)[0], fine):
            messages.append(f"{disc} cannot reach every room")
    labels, _ = components(distance > RADIUS - 1e-3)
    if len(np.unique(labels[(fine > 0) & (distance >= SPAWN)])) > 1:
        messages.append("an agent cannot reach every point to spawn at")
    if any(not (distance[fine == room] >= SPAWN).any() for room in range(1, rooms + 1)):
        messages.append("a room has no point to spawn at")
    light_cells = tuple(geometry.indices(g.lights, g.masks.shape, g.res).T)
    if not np.array_equal(g.masks[light_cells], np.arange(1, rooms + 1)):
        messages.append("a light is not in its room")
    if (distance[tuple(geometry.indices(g.lights, distance.shape, cell).T)] < LIT).any():
        messages.append("a light is in a wall")
    return messages
