"""How directly PointGoal can be walked by someone who knows only what it has seen: a planner.

    python scripts/planner.py --pairs 80

A planner is the classical baseline of PointGoal (the free-space assumption of Koenig and Likhachev,
"D* Lite", 2002). It keeps a grid of the walls that were in view so far, takes everything else for
free, walks along the shortest path there, and plans anew when a wall in view blocks it. It knows
where it is, turns on the spot, and stops within a cell of the goal, so its SPL is what seeing costs
without what moving costs. Prints the mean SPL over pairs of places per source of homes, with 95 %
intervals over pairs. Needs SciPy, which `pip install megastep-flatland[sweep]` brings.
"""

import argparse
import sys
from concurrent import futures
from pathlib import Path

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from megastep import engine, geometries
from megastep.agents.evaluation.statistics import interval
from megastep.envs.pointgoal import geodesics
from megastep.envs.pointgoal.path_graph import PathGraph

SOURCES = {
    "generated homes": ("homes", {}),
    "the same, geometry.density=3": ("homes", dict(density=3.0)),
    "geometry.density=3 geometry.clutter=1": ("homes", dict(density=3.0, clutter=1.0)),
    "bench homes": ("bench", {}),
    "perfect mazes": ("maze", {}),
    "braided mazes": ("maze", dict(braid=1.0)),
}
N_HOMES = 40
NEAREST, FURTHEST = 1, 15  # metres
CELL = 0.05  # metres
MARGIN = 0.3  # metres of the grid around the walls
FOV = 130  # degrees
N_RAYS = 256
SIGHT = 10  # metres
TOUCH = 0.35  # metres: walls this near are known once the planner bumps
# knight's moves too: paths on a grid are then at most 3 % longer than straight
MOVES = [(0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1)]


class Grid:
    """The cells of a home, `size` metres wide, and which of them an agent cannot stand in. Axes are
    x and y.
    """

    def __init__(self, walls: np.ndarray, size: float = CELL):
        ends, self.size = walls.reshape(-1, 2), size
        self.origin = ends.min(0) - MARGIN
        self.shape = tuple(np.ceil((ends.max(0) + MARGIN - self.origin) / size).astype(int) + 1)
        numbers = np.arange(np.prod(self.shape)).reshape(self.shape)
        starts, stops, lengths = [], [], []
        for x, y in MOVES:
            from_cells = numbers[: -x or None, max(0, -y) : -y if y > 0 else None]
            to_cells = numbers[x:, max(0, y) : y if y < 0 else None]
            starts.append(from_cells.ravel())
            stops.append(to_cells.ravel())
            lengths.append(np.full(from_cells.size, size * np.hypot(x, y)))
        self.edges = [np.concatenate(parts) for parts in (starts, stops, lengths)]

    def cell(self, point: np.ndarray) -> int:
        return np.ravel_multi_index(
            np.rint((point - self.origin) / self.size).astype(int), self.shape
        )

    def centre(self, cell: int) -> np.ndarray:
        return self.origin + self.size * np.array(np.unravel_index(cell, self.shape))

    def blocked(self, walls: np.ndarray) -> np.ndarray:
        """Returns which cells (X, Y) are within an agent's radius of walls (n, 2, 2)."""
        blocked = np.zeros(self.shape, bool)
        for start, stop in walls:
            low = np.minimum(start, stop) - self.origin - engine.AGENT_RADIUS
            high = np.maximum(start, stop) - self.origin + engine.AGENT_RADIUS
            x, y = (
                np.arange(max(0, int(a / self.size)), min(n, int(b / self.size) + 2))
                for a, b, n in zip(low, high, self.shape)
            )
            centres = self.origin + self.size * np.stack(np.meshgrid(x, y, indexing="ij"), -1)
            offsets = centres - nearest_on(start, stop - start, centres)
            blocked[np.ix_(x, y)] |= (offsets**2).sum(-1) < engine.AGENT_RADIUS**2
        return blocked

    def paths(self, blocked: np.ndarray, goal: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the distance of each cell to the goal, inf if there is no path, and the next cell
        on the way.
        """
        starts, stops, lengths = self.edges
        blocked = blocked.ravel()
        fits = ~(blocked[starts] | blocked[stops])
        graph = sparse.csr_matrix((lengths[fits], (starts[fits], stops[fits])), 2 * [blocked.size])
        return csgraph.dijkstra(graph, directed=False, indices=goal, return_predecessors=True)


def nearest_on(start, along, points):
    """Returns the points of segments that are nearest to points (..., 2)."""
    share = ((points - start) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12)
    return start + share.clip(0, 1)[..., None] * along


class Planner:
    """Walks to a goal. Knows of each wall the part that was in view: [from, to] of its length."""

    def __init__(self, walls: np.ndarray, grid: Grid, start: int, goal: int, yaw: float):
        self.walls, self.grid, self.goal = walls, grid, goal
        self.truth = grid.blocked(walls).ravel()
        self.known = np.tile([np.inf, -np.inf], (len(walls), 1))
        self.cell, self.yaw, self.walked = start, yaw, 0.0
        self.blocked = np.zeros(grid.shape, bool)
        self.look()
        self.plan()

    def walk(self, furthest: float) -> float:
        """Walks to the goal. Returns the metres walked, inf beyond `furthest`."""
        while self.cell != self.goal:
            step = self.following[self.cell]
            if step < 0 or self.walked > furthest:
                return np.inf
            move = self.grid.centre(step) - self.grid.centre(self.cell)
            if self.turn(np.arctan2(*move[::-1])) and self.plan():
                continue
            if self.truth[step]:
                self.bump(step)
                continue
            self.walked += np.hypot(*move)
            self.cell = step
            if self.look():
                self.plan()
        return self.walked

    def plan(self) -> bool:
        """Plans with the walls known so far. Returns whether a cell is blocked that was not."""
        seen = self.known[:, 0] <= self.known[:, 1]
        start, along = self.walls[seen, :1], np.diff(self.walls[seen], axis=1)
        blocked = self.blocked | self.grid.blocked(start + self.known[seen, :, None] * along)
        blocked.ravel()[[self.cell, self.goal]] = False
        is_new = (blocked & ~self.blocked).any() or not hasattr(self, "following")
        if is_new:
            self.blocked = blocked
            _, self.following = self.grid.paths(blocked, self.goal)
        return is_new

    def turn(self, yaw: float) -> bool:
        """Turns on the spot, looking on the way. Returns whether a wall came into view."""
        angle = (yaw - self.yaw + np.pi) % (2 * np.pi) - np.pi
        n_looks, before, found = int(abs(angle) // 0.6) + 1, self.yaw, False
        if abs(angle) < 0.3:
            return False
        for i in range(n_looks):
            self.yaw = before + angle * (i + 1) / n_looks
            found |= self.look()
        return found

    def look(self) -> bool:
        """Adds the walls in view to those known. Returns whether there are new ones."""
        angles = self.yaw + np.deg2rad(np.linspace(-FOV / 2, FOV / 2, N_RAYS))
        ray_x, ray_y = np.cos(angles)[:, None], np.sin(angles)[:, None]
        to_x, to_y = (self.walls[:, 0] - self.grid.centre(self.cell)).T
        along_x, along_y = (self.walls[:, 1] - self.walls[:, 0]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = ray_x * along_y - ray_y * along_x
            distance = (to_x * along_y - to_y * along_x) / cross
            share = (to_x * ray_y - to_y * ray_x) / cross
            hits = (distance > 0) & (distance < SIGHT) & (share >= 0) & (share <= 1)
        distance = np.where(hits, distance, np.inf)
        nearest = distance.argmin(1)
        rays = np.flatnonzero(hits.any(1))
        before = self.known.copy()
        shares = share[rays, nearest[rays]]
        np.minimum.at(self.known[:, 0], nearest[rays], shares)
        np.maximum.at(self.known[:, 1], nearest[rays], shares)
        return self.has_news(before)

    def bump(self, step: int) -> None:
        """Comes to know the walls around it; if it knew them, that a cell is blocked."""
        here, along = self.grid.centre(self.cell), self.walls[:, 1] - self.walls[:, 0]
        nearest = nearest_on(self.walls[:, 0], along, here)
        near = np.hypot(*(nearest - here).T) < TOUCH
        length = np.hypot(*along.T)
        share = np.hypot(*(nearest - self.walls[:, 0]).T) / np.maximum(length, 1e-9)
        reach = TOUCH / np.maximum(length, 1e-9)
        before = self.known.copy()
        low, high = (share - reach).clip(0), (share + reach).clip(max=1)
        self.known[near, 0] = np.minimum(self.known[:, 0], low)[near]
        self.known[near, 1] = np.maximum(self.known[:, 1], high)[near]
        if not (self.has_news(before) and self.plan()):
            self.blocked.ravel()[step] = True
            _, self.following = self.grid.paths(self.blocked, self.goal)

    def has_news(self, before):
        """Returns whether more of a wall is known than before, by more than a cell."""
        length = np.hypot(*(self.walls[:, 1] - self.walls[:, 0]).T)[:, None]
        with np.errstate(invalid="ignore"):
            more = np.abs(before - self.known) * length
        return bool((more > CELL).any())


def spl_of(job: tuple) -> list[float]:
    """Returns the SPL of each of several walks in a home. `job`: home, seed, number of walks."""
    home, seed, n_walks = job
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    graph = PathGraph([home], engine.AGENT_RADIUS, torch.device("cpu"))
    points = geodesics.draw_points(graph, 24, [rng])
    goals, spawns = (
        part[0] + graph.origins[0] for part in geodesics.largest_part(graph, points, 8, 8)
    )
    walls = np.asarray(home["walls"], float)
    grid, found = Grid(walls), []
    truth = grid.blocked(walls)
    for _ in range(n_walks):
        start, goal = (grid.cell(rng.choice(places)) for places in (spawns, goals))
        if truth.ravel()[[start, goal]].any():
            continue
        shortest = grid.paths(truth, goal)[0][start]
        if NEAREST <= shortest <= FURTHEST:  # inf too is left out: the grid misses narrow gaps
            planner = Planner(walls, grid, start, goal, rng.uniform(-np.pi, np.pi))
            found.append(shortest / max(shortest, planner.walk(10 * shortest + 30)))
    return found


def main(argv: list[str] | None = None) -> None:
    """Prints a table in Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=80, help="pairs of places per source, about")
    parser.add_argument("--jobs", type=int, help="processes, by default one per core")
    arguments = parser.parse_args(argv)
    n_walks = -(-arguments.pairs // N_HOMES)
    print("| homes | SPL of a planner | pairs |\n| --- | --- | --- |")
    with futures.ProcessPoolExecutor(arguments.jobs) as pool:
        for title, (source, options) in SOURCES.items():
            homes = geometries.sample(source, N_HOMES, split="test", seed=1, **options)
            jobs = [(home, seed, n_walks) for seed, home in enumerate(homes)]
            found = np.array([spl for each in pool.map(spl_of, jobs) for spl in each])
            mean, lower, upper = interval(found)
            print(
                f"| {title} | {mean:.3f} ({lower:.3f} to {upper:.3f}) | {len(found)} |", flush=True
            )


if __name__ == "__main__":
    main()
