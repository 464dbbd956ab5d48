"""Spawning: points where agents fit, found once per layout, and the module that puts agents there.

N environments, A agents, D layouts, P points, M walls.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from megastep import cache, engine
from megastep.geometry import centers, hashed
from megastep.modules.lanes import to_agents

CLEARANCE = 0.05  # metres from a spawned agent's collision disc to walls and to others spawned
PREFIX = "spawn-points-"  # of their files in the cache
MAX_FILES = 64  # of them, half a megabyte each for 512 layouts
MIN_CACHED = 32  # layouts; the points of fewer are found in no time
BATCHES = 20  # of candidates that are tried before a geometry is held to have no more room


def distances(points, walls):
    """(P,) float64 metres from points (P, 2) to the nearest of walls (M, 2, 2)."""
    (ax, ay), (vx, vy) = walls[:, 0].T, (walls[:, 1] - walls[:, 0]).T
    dx, dy = points[:, :1] - ax, points[:, 1:] - ay
    along = (dx * vx + dy * vy) / np.maximum(vx * vx + vy * vy, 1e-12)
    np.clip(along, 0, 1, out=along)
    dx -= along * vx
    dy -= along * vy
    return np.sqrt((dx * dx + dy * dy).min(1))


def _candidates(g, n, random):
    """Batches (n, 2) of points drawn evenly from the rooms of a geometry."""
    i, j = (g.masks > 0).nonzero()
    if not len(i):
        raise ValueError(f"geometry {g.id} has no room to spawn in: its masks need cells above 0")
    for _ in range(BATCHES):
        choice = random.integers(len(i), size=4 * n)
        cells = centers(np.stack([i[choice], j[choice]], 1), g.masks.shape, g.res)
        yield from np.split(cells + random.uniform(-0.5, 0.5, (4 * n, 2)) * g.res, 4)


def _dealt(points, owners, found, n_agents, size, gap):
    """``points`` (P, 2) and the agents they belong to, ``owners`` (P,), with those of ``found`` (F,
    2) that fit: one for each agent in turn, none nearer than ``gap`` to another agent's.
    """
    if n_agents == 1:
        points = np.concatenate([points, found])[:size]
        return points, np.zeros(len(points), int)
    points = np.concatenate([points, found])
    owners = np.concatenate([owners, np.full(len(found), -1)])  # -1: of no agent
    close = ((found[:, None] - points) ** 2).sum(-1) < gap**2
    counts = np.bincount(owners + 1, minlength=n_agents + 1)[1:].tolist()
    for p, neighbours in enumerate(close, len(points) - len(found)):
        near = set(owners[neighbours].tolist()) - {-1}
        agent = min(near, default=counts.index(min(counts)))
        if len(near) < 2 and counts[agent] == min(counts) < size:
            owners[p] = agent
            counts[agent] += 1
    return points[owners >= 0], owners[owners >= 0]


def spawn_points(
    g: Any, n: int, n_agents: int, radius: float, random: np.random.Generator
) -> np.ndarray:
    """(n_agents * (n // n_agents), 2) float64 points in the rooms of a geometry, each agent's end
    to end. A disc of ``radius`` about a point is 5 cm clear of every wall, and of the discs about
    other agents' points. Where fewer fit, some come again. ValueError if there are none.
    """
    size, points, owners = n // n_agents, np.empty((0, 2)), np.empty(0, int)
    from_wall, apart = radius + CLEARANCE, 2 * radius + CLEARANCE
    for batch in _candidates(g, n, random):
        found = batch[distances(batch, g.walls) > from_wall]
        points, owners = _dealt(points, owners, found, n_agents, size, apart)
        if len(points) == n_agents * size:
            return points[owners.argsort(kind="stable")]
    if not len(points):
        raise ValueError(
            f"geometry {g.id} has no point in a room that is {from_wall:.2f} m from every wall"
        )
    shares = [points[owners == agent] for agent in range(n_agents)]
    if not min(map(len, shares)):
        raise ValueError(
            f"geometry {g.id} has no room for {n_agents} agents at once, {apart:.2f} m apart"
        )
    return np.concatenate([share[random.integers(len(share), size=size)] for share in shares])


class RandomSpawns:
    """Puts agents at random points in the rooms of their environment's layout, at rest, looking
    anywhere.

    ``points`` (D, A * (n_spawns // A), 2) float32 are found once, 5 cm clear of the walls; each
    agent has some of its own, 5 cm clear of all other agents'. So agents that respawn together
    never overlap; one that respawns alone may land on another that has walked there, and the
    physics lets overlapping discs part. With ``resample`` an environment whose agents all respawn
    moves to another layout first. With ``hidden`` an agent respawns out of sight of the others that
    stand in its environment, or if it has no such point, as far from them as it can.

    Args: ``geometries`` are those the scenery was made from; ``n_spawns`` points per layout;
    ``points`` (D, A * n, 2) float32 to spawn at instead, each agent's end to end. ``chosen`` (N, A)
    int32 are the numbers of the points where agents spawned last.
    """

    def __init__(
        self,
        geometries: Sequence[Any],
        core: Any,
        n_spawns: int = 128,
        resample: bool = False,
        seed: int | None = None,
        hidden: bool = False,
        points: torch.Tensor | None = None,
    ):
        if n_spawns < core.n_agents:
            raise ValueError(
                f"n_spawns must be at least one point for each of the {core.n_agents} agents, but "
                f"{n_spawns} was given"
            )
        self.core, self.resample, self.hidden = core, resample, hidden
        self.seed = core.seed if seed is None else seed
        if points is None:
            geometries = geometries[: len(core.scenery.layouts)]
            given = n_spawns, core.n_agents, core.agents.radius, self.seed
            points = _cached_points(geometries, *given)
        self.points = torch.as_tensor(points, device=core.device)
        self.counts, self.chosen = (
            torch.zeros((core.n_envs, core.n_agents), dtype=torch.int32, device=core.device)
            for _ in range(2)
        )

    def __call__(self, reset: torch.Tensor) -> None:
        """Respawns the agents marked in ``reset``, (N, A) or (B,) bool."""
        engine.spawn(
            self.core.scenery,
            self.core.agents,
            to_agents(reset, self.core.n_agents),
            self.points,
            self.counts,
            self.seed,
            self.resample,
            self.hidden,
            self.chosen,
        )


def _all_points(geometries, n_spawns, n_agents, radius, seed):
    """(D, A * (n_spawns // A), 2) float32: the points of every layout."""
    points = [
        spawn_points(
            g, n_spawns, n_agents, radius, np.random.Generator(np.random.Philox([seed, d]))
        )
        for d, g in enumerate(geometries)
    ]
    return np.stack(points).astype(np.float32)


def _cached_points(geometries, *arguments):
    """:func:`_all_points`, from the cache if the same were found before."""
    if len(geometries) < MIN_CACHED:
        return _all_points(geometries, *arguments)
    key = hashed(geometries)
    key.update(Path(__file__).read_bytes() + repr((np.__version__, arguments)).encode())

    def build():
        cache.prune(PREFIX, MAX_FILES - 1)
        return _all_points(geometries, *arguments).tobytes()

    body, _ = cache.fetch(f"{PREFIX}{key.hexdigest()[:20]}", build)
    return np.frombuffer(body, np.float32).reshape(len(geometries), -1, 2).copy()
