"""Spawning: a search for points where agents fit, and a module that puts agents there. N
environments, A agents, D layouts, P points, M walls.
"""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from megastep import cache, engine
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.engine import checks
from megastep.geometry import centers, contents
from megastep.modules.movement import to_agents

CLEARANCE = 0.05  # metres between a spawned agent's disc and walls, or other spawned agents
PREFIX = "spawn-points-"  # of the files in the cache
MAX_FILES = 64  # in the cache, half a megabyte each for 512 layouts
MIN_CACHED = 32  # layouts; the search is quick for fewer
MAX_SPAWNS = 1_000_000  # points per layout; four times as many are drawn at once
BATCHES = 20  # of candidate points; then the search ends


def distances(points, walls) -> np.ndarray:
    """Returns the metres, (P,) float64, from points (P, 2) to the nearest of walls (M, 2, 2);
    infinite without walls.
    """
    (ax, ay), (vx, vy) = walls[:, 0].T, (walls[:, 1] - walls[:, 0]).T
    dx, dy = points[:, :1] - ax, points[:, 1:] - ay
    along = (dx * vx + dy * vy) / np.maximum(vx * vx + vy * vy, 1e-12)
    np.clip(along, 0, 1, out=along)
    dx -= along * vx
    dy -= along * vy
    return np.sqrt((dx * dx + dy * dy).min(1, initial=np.inf))


def candidates(g, n, random) -> Iterator[np.ndarray]:
    """Yields batches (n, 2) of points, drawn uniformly from the rooms of a geometry."""
    i, j = (g.masks > 0).nonzero()
    if not len(i):
        raise ValueError(f"geometry {g.id} has no room to spawn in: no cell of masks is above 0")
    for _ in range(BATCHES):
        choice = random.integers(len(i), size=4 * n)
        cells = centers(np.stack([i[choice], j[choice]], 1), g.masks.shape, g.res)
        yield from np.split(cells + random.uniform(-0.5, 0.5, (4 * n, 2)) * g.res, 4)


def _assign(points, owners, candidates, n_agents, size, gap) -> tuple[np.ndarray, np.ndarray]:
    """Gives candidate points (F, 2) to agents in turn, at most ``size`` each, none nearer than
    ``gap`` to a point of another agent. Returns all points, and the agent of each.
    """
    if n_agents == 1:
        points = np.concatenate([points, candidates])[:size]
        return points, np.zeros(len(points), int)
    points = np.concatenate([points, candidates])
    owners = np.concatenate([owners, np.full(len(candidates), -1)])  # -1: no agent
    close = ((candidates[:, None] - points) ** 2).sum(-1) < gap**2
    counts = np.bincount(owners + 1, minlength=n_agents + 1)[1:].tolist()
    for p, neighbours in enumerate(close, len(points) - len(candidates)):
        near_agents = set(owners[neighbours].tolist()) - {-1}
        agent = min(near_agents, default=counts.index(min(counts)))
        if len(near_agents) < 2 and counts[agent] == min(counts) < size:
            owners[p] = agent
            counts[agent] += 1
    return points[owners >= 0], owners[owners >= 0]


def spawn_points(
    g: dotdict, n: int, n_agents: int, radius: float, random: np.random.Generator
) -> np.ndarray:
    """Returns points in the rooms of a geometry, (n_agents * (n // n_agents), 2) float64, those of
    agent 0 first. A disc of ``radius`` metres around each is 5 cm clear of every wall and of other
    agents' discs. If fewer fit, some are repeated. ValueError if an agent has none.
    """
    size, points, owners = n // n_agents, np.empty((0, 2)), np.empty(0, int)
    from_wall, apart = radius + CLEARANCE, 2 * radius + CLEARANCE
    for batch in candidates(g, n, random):
        clear = batch[distances(batch, g.walls) > from_wall]
        points, owners = _assign(points, owners, clear, n_agents, size, apart)
        if len(points) == n_agents * size:
            return points[owners.argsort(kind="stable")]
    if not len(points):
        raise ValueError(
            f"geometry {g.id} has no point in a room that is {from_wall:.2f} m from every wall"
        )
    per_agent = [points[owners == agent] for agent in range(n_agents)]
    if not min(map(len, per_agent)):
        raise ValueError(
            f"geometry {g.id} has no room for {n_agents} agents at once, {apart:.2f} m apart"
        )
    return np.concatenate(
        [of_agent[random.integers(len(of_agent), size=size)] for of_agent in per_agent]
    )


class RandomSpawns:
    """Puts agents at random points in the rooms of their layout, at rest, with a random heading.

    Each agent has spawn points of its own, 5 cm clear of the walls and of the other agents' points.
    So agents that respawn together never overlap. An agent that respawns alone may land on another
    that has walked there; physics lets overlapping discs part.

    Args:
        geometries: those that the scenery was made from.
        core: the environment's core.
        n_spawns: points per layout, shared out among the agents.
        resample: move an environment to a random layout whenever all its agents respawn.
        seed: of the points and spawns. Default: the core's.
        hidden: respawn out of sight of the other agents in the environment. If no point is, take
            the one furthest from them.
        points: (D, A * n, 2) float32, points to use instead, those of agent 0 first.

    Attributes:
        points: (D, A * (n_spawns // A), 2) float32, those of agent 0 first.
        point_index: (N, A) int32, index into ``points`` of each agent's last spawn point.
    """

    def __init__(
        self,
        geometries: Sequence[dotdict],
        core: Core,
        n_spawns: int = 128,
        resample: bool = False,
        seed: int | None = None,
        hidden: bool = False,
        points: torch.Tensor | None = None,
    ):
        n_spawns = checks.integer("n_spawns", n_spawns, 1, MAX_SPAWNS)
        if n_spawns < core.n_agents:
            raise ValueError(
                f"n_spawns={n_spawns} is less than one point for each of the {core.n_agents} agents"
            )
        self.core = core
        self._n_layouts = len(core.scenery.layouts)
        self.resample = checks.flag("resample", resample)
        self.hidden = checks.flag("hidden", hidden)
        self.seed = core.seed if seed is None else checks.integer("seed", seed, 0)
        if points is None:
            geometries = geometries[: len(core.scenery.layouts)]
            size = n_spawns, core.n_agents, core.agents.radius
            points = torch.from_numpy(cached_points(geometries, *size, self.seed))
        self.points = torch.as_tensor(points, device=core.device)
        self.counts, self.point_index = (
            torch.zeros((core.n_envs, core.n_agents), dtype=torch.int32, device=core.device)
            for _ in range(2)
        )
        #: (D,) int32, cumulative weights by which layouts are drawn, see ``engine.spawn``. None:
        #: every layout is as likely.
        self.cumulative: torch.Tensor | None = None

    def __call__(self, reset: torch.Tensor) -> None:
        """Respawns the agents where ``reset``, (N, A) or (B,) bool, is True."""
        checks.length("reset", reset)
        engine.spawn(
            self.core.scenery,
            self.core.agents,
            to_agents(reset, self.core.n_agents),
            self.points,
            self.counts,
            self.seed,
            self.resample,
            self.hidden,
            self.point_index,
            self.cumulative,
        )

    def weigh_layouts(self) -> torch.Tensor:
        """Has layouts be drawn by weights from now on, first by equal ones. Returns ``cumulative``,
        to be changed in place.

        Raises:
            ValueError: if environments keep their layouts.
        """
        if not self.resample:
            raise ValueError("environments keep their homes: use resample=True to draw them anew")
        if self.cumulative is None:
            n, device = self._n_layouts, self.core.device
            self.cumulative = torch.arange(1, n + 1, dtype=torch.int32, device=device)
        return self.cumulative


def cached_points(
    geometries: Sequence[dotdict], n: int, n_agents: int, radius: float, seed: int
) -> np.ndarray:
    """Returns the :func:`spawn_points` of every layout, (D, n_agents * (n // n_agents), 2) float32,
    for many layouts by the cache.
    """

    def build() -> dict[str, np.ndarray]:
        generators = (np.random.Generator(np.random.Philox([seed, d])) for d in itertools.count())
        points = [spawn_points(g, n, n_agents, radius, r) for g, r in zip(geometries, generators)]
        return dict(points=np.stack(points).astype(np.float32))

    if len(geometries) < MIN_CACHED:
        return build()["points"]
    parts = Path(__file__), n, n_agents, radius, seed, *contents(geometries)
    return cache.arrays(PREFIX, parts, build, MAX_FILES)["points"]
