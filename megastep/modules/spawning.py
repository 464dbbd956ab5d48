"""Spawning: a search for points where agents fit, and modules that put agents there or draw such
points. N environments, A agents, D layouts, P points, M walls.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from megastep import cache, engine
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.engine import checks
from megastep.geometry import centers, contents
from megastep.modules.lifecycle import CounterGenerator, derived_seed

T = TypeVar("T")
CLEARANCE = 0.05  # metres between a spawned agent's disc and walls, or other spawned agents
PREFIX = "spawn-points-"  # of the files in the cache
MAX_FILES = 256  # of each kind in the cache: two or more for each member of a population
MIN_CACHED = 32  # layouts; the search is quick for fewer
MAX_SPAWNS = 1_000_000  # points per layout; four times as many are drawn at once
BATCHES = 20  # of candidate points; then the search ends


def distances(points, walls) -> np.ndarray:
    """Returns metres, (P,) float64, from points (P, 2) to the nearest wall (M, 2, 2), or inf."""
    (ax, ay), (vx, vy) = walls[:, 0].T, (walls[:, 1] - walls[:, 0]).T
    dx, dy = points[:, :1] - ax, points[:, 1:] - ay
    along = (dx * vx + dy * vy) / np.maximum(vx * vx + vy * vy, 1e-12)
    np.clip(along, 0, 1, out=along)
    dx -= along * vx
    dy -= along * vy
    return np.sqrt((dx * dx + dy * dy).min(1, initial=np.inf))


def per_geometry(
    geometries: Sequence[dotdict], seed: int, function: Callable[[dotdict, np.random.Generator], T]
) -> list[T]:
    """Returns what a function of a geometry and a generator gives for each; equal ones share it."""
    found: dict[int, T] = {}
    for g in geometries:
        if id(g) not in found:
            random = np.random.Generator(np.random.Philox([seed, len(found)]))
            found[id(g)] = function(g, random)
    return [found[id(g)] for g in geometries]


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
    """Gives candidates (F, 2) to agents in turn, ``gap`` apart. Returns points and agents."""
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
    Each has spawn points of its own, 5 cm clear of the walls and of the other agents' points, so
    agents that respawn together never overlap. One that respawns alone may land on another that has
    walked there; physics lets overlapping discs part.

    Args:
        geometries: those that the scenery was made from.
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
        self.core, self._n_layouts = core, len(core.scenery.layouts)
        self.resample = checks.flag("resample", resample)
        self.hidden = checks.flag("hidden", hidden)
        self.seed = core.seed if seed is None else checks.integer("seed", seed, 0)
        if points is None:
            size = n_spawns, core.n_agents, core.agents.radius
            points = torch.from_numpy(cached_points(of_layouts(geometries, core), *size, self.seed))
        self.points = torch.as_tensor(points, device=core.device)
        zeros = torch.zeros((core.n_envs, core.n_agents), dtype=torch.int32, device=core.device)
        self.counts, self.point_index = zeros, zeros.clone()
        #: (D,) int32, cumulative weights by which layouts are drawn, see ``engine.spawn``. None:
        #: every layout is as likely.
        self.cumulative: torch.Tensor | None = None

    def __call__(self, reset: torch.Tensor) -> None:
        """Respawns the agents where ``reset``, (N, A) or (B,) bool, is True."""
        checks.length("reset", reset)
        core, draws = self.core, (self.points, self.counts, self.seed)
        options = self.resample, self.hidden, self.point_index, self.cumulative
        mask = reset.reshape(-1, core.n_agents)
        engine.spawn(core.scenery, core.agents, mask, *draws, *options)

    def weigh_layouts(self) -> torch.Tensor:
        """Has layouts be drawn by weights from now on, first by equal ones. Returns ``cumulative``,
        to be changed in place. ValueError if environments keep their layouts.
        """
        if not self.resample:
            raise ValueError("environments keep their homes: use resample=True to draw them anew")
        if self.cumulative is None:
            n, device = self._n_layouts, self.core.device
            self.cumulative = torch.arange(1, n + 1, dtype=torch.int32, device=device)
        return self.cumulative


def of_layouts(geometries: Sequence[dotdict], core: Core) -> Sequence[dotdict]:
    """Returns the geometry of each layout of the scenery. ValueError unless there are as many, or
    more of one and the same.
    """
    n = len(core.scenery.layouts)
    if len(geometries) < n or len(geometries) > n and len({*map(id, geometries)}) > 1:
        raise ValueError(
            f"geometries must be those that the scenery was made from, one for each of its {n} "
            f"layouts, but {len(geometries)} were given: use the list that scene.scenery got, such "
            "as scene.spread(geometries, n_envs)"
        )
    return geometries[:n]


def cached_points(
    geometries: Sequence[dotdict], n: int, n_agents: int, radius: float, seed: int
) -> np.ndarray:
    """Returns the :func:`spawn_points` of layouts, (D, n_agents * (n // n_agents), 2) float32."""

    def build() -> dict[str, np.ndarray]:
        generators = (np.random.Generator(np.random.Philox([seed, d])) for d in itertools.count())
        points = [spawn_points(g, n, n_agents, radius, r) for g, r in zip(geometries, generators)]
        return dict(points=np.stack(points).astype(np.float32))

    arguments = n, n_agents, radius, seed
    return cached(PREFIX, Path(__file__), geometries, arguments, build)["points"]


def cached(
    prefix: str, source: Path, geometries: Sequence[dotdict], arguments: object, build: Callable
) -> dict[str, np.ndarray]:
    """Returns the arrays that ``build``, a function in the file ``source``, makes of geometries and
    arguments. Keeps those of many geometries in the cache, in files of a ``prefix``.
    """
    if len(geometries) < MIN_CACHED:
        return build()
    return cache.arrays(prefix, (source, arguments, *contents(geometries)), build, MAX_FILES)


class FreePoints:
    """Draws random points in the rooms of environments' homes, such as goals or places for objects,
    where an agent is 5 cm clear of every wall. A point is drawn in the layout that the environment
    shows at the call, so call it after the spawner. The k-th draw is the same on the CPU, on a GPU
    and in a CUDA graph; a call does not synchronise. Raises ValueError if a geometry has no point
    where an agent fits, or there is not one geometry for each layout.

    Args:
        geometries: those that the scenery was made from.
        n_points: points per layout to draw from.
        per_env: points drawn per environment, K. Default: one per agent.
        seed: of the points and draws. Default: the core's. Equal seeds draw equal points.

    Attributes:
        points: (D, n_points, 2) float32 metres, the points of each layout.
    """

    def __init__(
        self,
        geometries: Sequence[dotdict],
        core: Core,
        n_points: int = 128,
        per_env: int | None = None,
        seed: int | None = None,
    ):
        per_env = core.n_agents if per_env is None else per_env
        self.core, self.per_env = core, checks.integer("per_env", per_env, 1)
        n_points = checks.integer("n_points", n_points, 1, MAX_SPAWNS)
        seed = core.seed if seed is None else checks.integer("seed", seed, 0)
        seed = derived_seed(seed, "points")
        geometries = of_layouts(geometries, core)
        points = cached_points(geometries, n_points, 1, core.agents.radius, seed)
        self.points = torch.as_tensor(points, device=core.device)
        self.generator = CounterGenerator(core.n_envs * self.per_env, seed, core.device)

    def __call__(self, mask: torch.Tensor) -> torch.Tensor:
        """Draws new points where ``mask``, (N, K) or (N * K,) bool, is True. Returns (N, K, 2)
        float32 metres: elsewhere the points of the last draw or, if the environment has moved to
        another layout since, arbitrary ones of that.
        """
        n_points = self.points.shape[1]
        index = (self.generator(mask)[:, 0] * n_points).long().view(-1, self.per_env)
        rows = self.core.scenery.layout.long()[:, None] * n_points + index
        return self.points.flatten(0, 1)[rows]
