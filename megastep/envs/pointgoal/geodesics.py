"""Shortest paths of an agent's disc between walls, to random goals from anywhere.

Distances are computed in two ways:

* A *field* holds the distance to a goal from every cell of a grid, by Dijkstra's algorithm on 16
  neighbours per cell. It is a few per cent too long, but continuous, so progress is measured on it.
* The *length* of the shortest path from a spawn point to a goal is exact to millimetres. It is the
  length of the shortest polyline along which the disc touches no wall, from a visibility graph
  (Lozano-Perez and Wesley 1979) of goals, spawn points and points around the ends of walls.

M walls, H x W cells, G goals, S spawn points, P points, K pairs of points.
"""

from typing import Any, NamedTuple

import numpy as np

from megastep.modules.spawning import distances, spawn_points

CELL = 0.1  # metres, of fields
FINE = 2  # the clearance has cells this many times smaller
FAR = 0.5  # metres; the clearance is clipped here
RINGS = 3  # rings of cells inside walls that get a neighbour's distance, for interpolation
ARC = 8  # points around the end of a wall
STEP = 0.05  # metres between the points of a path that are tested
# Metres by which a path may be closer to a wall than an agent: the error of interpolated
# clearances, and the distance of an arc's chord from the arc.
TOLERANCE = 0.015
SPARE = 4  # times as many points are drawn as needed, as some may be in rooms without a door
# Half of the moves between neighbours (the others are their reverses): rows up, columns right, and
# the cells that a move passes.
MOVES = {
    (0, 1): [],
    (1, 0): [],
    (1, 1): [(0, 1), (1, 0)],
    (1, -1): [(0, -1), (1, 0)],
    (1, 2): [(0, 1), (1, 1)],
    (1, -2): [(0, -1), (1, -1)],
    (2, 1): [(1, 0), (1, 1)],
    (2, -1): [(1, 0), (1, -1)],
}


class Geodesics(NamedTuple):
    """Goals, spawn points and shortest paths of one geometry, in metres."""

    origin: np.ndarray  # (2,) float32: the centre of the first cell
    fields: np.ndarray  # (G, H, W) float16: distance to each goal or inf; row 0 at the bottom
    spawns: np.ndarray  # (S, 2) float32; every goal can be reached from each
    goals: np.ndarray  # (G, 2) float32
    lengths: np.ndarray  # (S, G) float32: of the shortest paths


class _Grid:
    """A grid of square cells (H, W), and the clearance on a grid `FINE` times finer: metres from a
    cell's centre to the nearest wall, at most `FAR`.
    """

    def __init__(self, walls):
        low, high = walls.min((0, 1)), walls.max((0, 1))
        self.origin = low.astype(np.float32).astype(np.float64)
        width, height = np.ceil((high - low) / CELL).astype(int) + 2
        self.clearance = np.full((FINE * height, FINE * width), FAR)
        for start, end in walls:
            self._add(start, end)

    def _add(self, start, end):
        """Lowers the clearance near a wall."""
        side = CELL / FINE
        low, high = np.minimum(start, end) - FAR, np.maximum(start, end) + FAR
        column, row = np.floor((low - self.origin) / side).astype(int).clip(0)
        last_column, last_row = np.ceil((high - self.origin) / side).astype(int)
        near = self.clearance[row : last_row + 1, column : last_column + 1]
        y, x = np.ogrid[row : row + near.shape[0], column : column + near.shape[1]]
        dx = self.origin[0] + side * x - start[0]
        dy = self.origin[1] + side * y - start[1]
        vx, vy = end - start
        along = ((dx * vx + dy * vy) / max(vx * vx + vy * vy, 1e-12)).clip(0, 1)
        dx, dy = dx - along * vx, dy - along * vy
        np.minimum(near, np.sqrt(dx * dx + dy * dy), out=near)

    def free(self, radius):
        """Returns (H, W) bool, the cells at whose centre a disc fits."""
        return self.clearance[::FINE, ::FINE] >= radius

    def read(self, values, points):
        """Returns `values` (..., H, W), of this grid or the finer one, interpolated at points
        (P, 2): (..., P).
        """
        height, width = values.shape[-2:]
        side = CELL * len(self.clearance) / (FINE * height)
        at = (points - self.origin) / side
        x = at[:, 0].clip(0, width - 1.001)
        y = at[:, 1].clip(0, height - 1.001)
        column, row = x.astype(int), y.astype(int)
        x, y = x - column, y - row
        index = row * width + column
        flat = values.reshape(*values.shape[:-2], -1)
        total = 0.0
        for offset, weight in (
            (0, (1 - x) * (1 - y)),
            (1, x * (1 - y)),
            (width, (1 - x) * y),
            (width + 1, x * y),
        ):
            total = total + np.where(weight > 0, flat[..., index + offset], 0.0) * weight
        return total

    def sees(self, starts, ends, least):
        """Returns (K,) bool, the straight paths from starts to ends, (K, 2) each, that stay at
        least `least` metres from all walls.
        """
        across = ends - starts
        n_steps = np.ceil(np.sqrt((across**2).sum(1)) / STEP).astype(int) + 1
        clear = np.ones(len(starts), bool)
        for n_points in (1, 3, 7, None):  # a few points rule out most paths that are not clear
            remaining = clear.nonzero()[0]
            counts = n_steps[remaining] if n_points is None else np.full(len(remaining), n_points)
            path = np.repeat(remaining, counts)
            step = np.arange(len(path)) - np.repeat(np.cumsum(counts) - counts, counts)
            fraction = (step + 1) / (np.repeat(counts, counts) + 1)
            points = starts[path] + fraction[:, None] * across[path]
            clear[path[self.read(self.clearance, points) < least]] = False
        return clear


def _graph(free):
    """Returns the numbers of the `free` cells (H, W), -1 elsewhere, and the moves between them:
    from, to and metres, (E,) each.
    """
    height, width = free.shape
    numbers = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
    padded = np.pad(free, 2)

    def at(i, j):
        return padded[2 + i : 2 + i + height, 2 + j : 2 + j + width]

    moves = []
    for (i, j), passed in MOVES.items():
        open_ = free & at(i, j)
        for cell in passed:
            open_ &= at(*cell)
        rows, columns = open_.nonzero()
        to = numbers[rows + i, columns + j]
        moves.append((numbers[rows, columns], to, np.full(len(to), CELL * np.hypot(i, j))))
    return numbers, *map(np.concatenate, zip(*moves))


def _entries(grid, numbers, points):
    """Returns the moves from points (P, 2) to free cells around them: point, cell, metres, (E,)."""
    nearest = np.rint((points - grid.origin) / CELL).astype(int)
    offsets = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(-1, 2)
    cells = (nearest[:, None] + offsets).reshape(-1, 2)
    height, width = numbers.shape
    inside = ((cells >= 0) & (cells < (width, height))).all(1)
    point, cells = np.repeat(np.arange(len(points)), 9)[inside], cells[inside]
    number = numbers[cells[:, 1], cells[:, 0]]
    metres = np.sqrt(((grid.origin + CELL * cells - points[point]) ** 2).sum(1))
    usable = (number >= 0) & (metres <= 1.5 * CELL)
    return point[usable], number[usable], metres[usable]


def _sparse(n, *moves):
    from scipy.sparse import csr_array

    starts, ends, metres = map(np.concatenate, zip(*moves))
    return csr_array((metres, (starts, ends)), shape=(n, n))


def _filled(fields, passable):
    """Fills the cells inside walls of fields (G, H, W): a neighbour's distance plus one cell."""
    for _ in range(RINGS):
        padded = np.pad(fields, ((0, 0), (1, 1), (1, 1)), constant_values=np.inf)
        around = np.minimum(
            np.minimum(padded[:, 2:, 1:-1], padded[:, :-2, 1:-1]),
            np.minimum(padded[:, 1:-1, 2:], padded[:, 1:-1, :-2]),
        )
        fields = np.where(np.isinf(fields) & ~passable, around + CELL, fields)
    return fields


def _corners(walls, radius):
    """Returns the points (C, 2) where a shortest path may bend, on arcs around the ends of walls,
    and the directions (C, 2) to them from those ends.
    """
    ends = np.unique(walls.reshape(-1, 2), axis=0)
    angles = 2 * np.pi * np.arange(ARC) / ARC
    away = np.tile(np.stack([np.cos(angles), np.sin(angles)], 1), (len(ends), 1))
    points = np.repeat(ends, ARC, axis=0) + radius * away
    fits = distances(points, walls) > radius - 1e-4
    points, away = points[fits], away[fits]
    aside = STEP * np.stack([-away[:, 1], away[:, 0]], 1)
    # Beside a straight wall, a step to either side keeps the distance: no path bends there.
    further = np.sqrt(radius**2 + STEP**2) - 1e-3
    bends = (distances(points + aside, walls) > further) | (
        distances(points - aside, walls) > further
    )
    return points[bends], away[bends]


def _pairs(points, away, n_goals, n_ends, to_goals):
    """Returns the pairs of points (P, 2) that may be neighbours on a shortest path, (K,) indices
    each.

    Points are goals, then spawns from `n_goals` on, then corners from `n_ends` on. `away` (P, 2)
    are the directions from the walls that corners touch, 0 for others. `to_goals` (G, P) are
    distances.

    Left out are pairs whose distances to a goal differ by more than the distance between them, as
    they cannot see each other, and pairs where the path would not bend around the end of the wall.
    """
    tangent = np.sin(np.pi / ARC) + 0.05
    pairs = []
    for i in range(n_ends, len(points)):
        across = points[:i] - points[i]
        straight = np.sqrt((across**2).sum(1))
        bent = np.maximum(np.abs(across @ away[i]), np.abs((across * away[:i]).sum(1)))
        partners = (bent <= tangent * straight).nonzero()[0]
        apart = np.abs(to_goals[:, partners] - to_goals[:, i, None]).max(0)
        partners = partners[apart <= 1.03 * straight[partners] + 2 * CELL]
        pairs.append(np.stack([np.full(len(partners), i), partners], 1))
    direct = np.indices((n_goals, n_ends - n_goals)).reshape(2, -1).T + (0, n_goals)
    starts, ends = np.concatenate([direct, *pairs]).T
    return starts, ends


def _lengths(grid, goals, spawns, corners, away, fields, radius):
    """Returns the lengths (S, G) of the shortest paths from spawns (S, 2) to goals (G, 2) that bend
    at corners (C, 2). `fields` (G, H, W) are distances to the goals.
    """
    from scipy.sparse.csgraph import dijkstra

    reached = np.isfinite(grid.read(fields, corners)).all(0)
    points = np.concatenate([goals, spawns, corners[reached]])
    n_goals, n_ends = len(goals), len(goals) + len(spawns)
    away = np.concatenate([np.zeros((n_ends, 2)), away[reached]])
    to_goals = grid.read(fields, points)
    starts, ends = _pairs(points, away, n_goals, n_ends, to_goals)
    clear = grid.sees(points[starts], points[ends], radius - TOLERANCE)
    starts, ends = starts[clear], ends[clear]
    metres = np.sqrt(((points[ends] - points[starts]) ** 2).sum(1))
    graph = _sparse(len(points), (starts, ends, metres))
    lengths = dijkstra(graph, directed=False, indices=np.arange(n_goals))[:, n_goals:n_ends].T
    return np.where(np.isfinite(lengths), lengths, to_goals[:, n_goals:n_ends].T)


def geodesics(
    g: Any, n_spawns: int, n_goals: int, radius: float, random: np.random.Generator
) -> Geodesics:
    """Draws goals and spawn points from the largest connected part of a geometry, and computes the
    shortest paths between them.

    Args:
        g: the geometry.
        n_spawns: number of spawn points S.
        n_goals: number of goals G.
        radius: of the agents, in metres.
        random: generator of the points.

    Raises:
        ValueError: naming the geometry, if it has no room for an agent.
    """
    from scipy.sparse.csgraph import connected_components, dijkstra

    walls = g.walls.astype(np.float64)
    grid = _Grid(walls)
    numbers, *moves = _graph(grid.free(radius))
    n_cells = int(numbers.max()) + 1
    points = spawn_points(g, SPARE * (n_spawns + n_goals), 1, radius, random)
    entries = _entries(grid, numbers, points)
    _, parts = connected_components(_sparse(n_cells, moves), directed=False)
    part_of_point = np.full(len(points), -1)
    part_of_point[entries[0]] = parts[entries[1]]
    if (part_of_point < 0).all():
        raise ValueError(
            f"geometry {g.id} has no room for an agent to walk in: it needs gaps at least "
            f"{2 * radius + CELL:.2f} m wide"
        )
    largest = np.bincount(part_of_point[part_of_point >= 0]).argmax()
    points = points[part_of_point == largest]
    goals = np.resize(points[:n_goals], (n_goals, 2))
    spawns = points[n_goals:] if len(points) > n_goals else points
    spawns = np.resize(spawns, (n_spawns, 2))

    starts, ends, metres = _entries(grid, numbers, goals)
    graph = _sparse(n_cells + n_goals, moves, (starts + n_cells, ends, metres))
    distance = dijkstra(graph, directed=False, indices=n_cells + np.arange(n_goals))
    free = numbers >= 0
    fields = np.full((n_goals, *free.shape), np.inf)
    fields[:, free] = distance[:, :n_cells]
    reached = np.isfinite(fields[0])
    fields = _filled(fields, free)
    lengths = _lengths(grid, goals, spawns, *_corners(walls, radius), fields, radius)

    rows, columns = (reached.any(axis).nonzero()[0] for axis in (1, 0))
    row, column = max(rows[0] - RINGS, 0), max(columns[0] - RINGS, 0)
    fields = fields[:, row : rows[-1] + RINGS + 1, column : columns[-1] + RINGS + 1]
    return Geodesics(
        origin=(grid.origin + CELL * np.array([column, row])).astype(np.float32),
        fields=fields.astype(np.float16),
        spawns=spawns.astype(np.float32),
        goals=goals.astype(np.float32),
        lengths=lengths.astype(np.float32),
    )
