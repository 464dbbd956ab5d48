"""Goals: where agents are sent, how far that is by the shortest way, and the module that draws one for
each episode.

N environments, A agents, D layouts, S spawn points and G goals per layout.
"""

import hashlib
import io
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import engine
from ..geometry import hashed
from ..kernels import cache
from ..workers import mapped
from . import spawning
from .geodesics import CELL, Geodesics, geodesics
from .lifecycle import RandomStream

PREFIX = "geodesics-"  # of their files in the cache
MAX_FILES, MAX_BYTES = 64, 10**9  # of all of them
N_GOALS = 16  # per layout
N_SPAWNS = 128


class RandomGoals:
    """Sends each agent to a random goal of its layout, no nearer and no further than allowed by the
    shortest way.

    ``spawns`` (D, S, 2) float32 are where agents may start: all have a goal within the range.
    ``fields`` are the distances to goals, an :class:`~megastep.engine.DistanceFields`. Of each agent
    ``chosen`` (N, A) int32 is the goal's number and ``lengths`` (N, A) float32 how far it was at the
    start, in metres: that of the shortest way, at any angle, along which the agent touches no wall.

    Args: ``geometries`` are those the scenery was made from; ``nearest`` and ``furthest`` metres.
    ValueError, naming the geometry, if one has no goal in that range.
    """

    def __init__(
        self,
        geometries: Sequence[Any],
        core: Any,
        nearest: float = 1.0,
        furthest: float = 15.0,
        seed: int | None = None,
    ):
        if not 0 <= nearest < furthest:
            raise ValueError(
                f"goals need 0 <= nearest < furthest metres, but {nearest:g} and {furthest:g} were "
                f"given"
            )
        self.core, device = core, core.device
        seed = core.seed if seed is None else seed
        geometries = geometries[: len(core.scenery.layouts)]
        found = all_geodesics(geometries, core.agents.radius, seed)
        rows = [
            _in_range(one, g, nearest, furthest) for one, g in zip(found, geometries, strict=True)
        ]
        spawns, lengths, order, counts = map(np.stack, zip(*rows))
        engine.fit(len(found), sum(one.fields.nbytes for one in found) / len(found), device, "layouts")
        points, fields, origins = (
            [getattr(one, name) for one in found] for name in ("goals", "fields", "origin")
        )
        self.fields = engine.DistanceFields(points, fields, origins, CELL, device)
        self.spawns = torch.from_numpy(spawns).to(device)
        self._tables = _Tables(lengths, order, counts, device)
        self.random = RandomStream(core.n_envs * core.n_agents, seed + (2 << 32), device)
        shape = core.n_envs, core.n_agents
        self.chosen = torch.zeros(shape, dtype=torch.int32, device=device)
        self.lengths = torch.zeros(shape, device=device)

    def __call__(self, reset: torch.Tensor, spawned: torch.Tensor) -> None:
        """Draws goals for the agents marked in ``reset``, (N, A) or (B,) bool, that spawned at these
        points of their layouts, (N, A) int32.
        """
        reset, tables = reset.view_as(self.chosen), self._tables
        spawn = self.core.scenery.layout[:, None] * N_SPAWNS + spawned
        chance = self.random(reset)[:, 0].view_as(self.lengths)
        place = (chance * tables.counts[spawn]).int()
        goal = tables.order[spawn * N_GOALS + place]
        length = tables.lengths[spawn * N_GOALS + goal]
        self.chosen.copy_(torch.where(reset, goal, self.chosen))
        self.lengths.copy_(torch.where(reset, length, self.lengths))


class _Tables:
    """By spawn point, which goals are in range: how many (D S,) and which, those first, (D S G,)
    int32; and the lengths of the ways to all (D S G,). They never change.
    """

    __slots__ = ("counts", "lengths", "order")

    def __init__(self, lengths, order, counts, device):
        self.lengths = torch.from_numpy(lengths).to(device).flatten()
        self.order = torch.from_numpy(order).to(device).flatten()
        self.counts = torch.from_numpy(counts).to(device).flatten()


def _in_range(found, g, nearest, furthest):
    """Spawn points (S, 2) with a goal in range, lengths (S, G), goals in range first (S, G) and how
    many those are (S,).
    """
    allowed = (found.lengths >= nearest) & (found.lengths <= furthest)
    kept = allowed.any(1).nonzero()[0]
    if not len(kept):
        raise ValueError(
            f"geometry {g.id} has no goal from {nearest:g} to {furthest:g} m from where agents spawn: "
            f"its ways are {found.lengths.min():.1f} to {found.lengths.max():.1f} m long, so allow "
            f"others, or leave it out"
        )
    kept = np.resize(kept, len(found.spawns))
    allowed = allowed[kept]
    order = np.argsort(~allowed, axis=1, kind="stable").astype(np.int32)
    return found.spawns[kept], found.lengths[kept], order, allowed.sum(1).astype(np.int32)


# ---- Found once, and kept ----


def _packed(item):
    """The geodesics of a geometry as bytes. Neighbouring distances differ little, so their
    differences are stored.
    """
    g, radius, seed, d = item
    random = np.random.Generator(np.random.Philox([seed, d]))
    found = geodesics(g, N_SPAWNS, N_GOALS, radius, random)
    differences = np.diff(found.fields.view(np.uint16), axis=2, prepend=np.uint16(0))
    file = io.BytesIO()
    np.savez(file, **found._replace(fields=differences)._asdict())
    return zlib.compress(file.getvalue(), 1)


def _unpacked(body):
    with np.load(io.BytesIO(zlib.decompress(body))) as arrays:
        found = Geodesics(**arrays)
    cells = np.cumsum(found.fields, axis=2, dtype=np.uint16)
    return found._replace(fields=cells.view(np.float16))


def all_geodesics(geometries: Sequence[Any], radius: float, seed: int) -> list[Geodesics]:
    """The geodesics of each geometry for agents of a radius, from the cache if they were found
    before; else by all the machine's cores, with a bar of progress if that takes long.
    """
    different = list({id(g): g for g in geometries}.values())
    key = hashed(different)
    for file in ("geodesics.py", "goals.py", "spawning.py"):
        key.update(Path(__file__).with_name(file).read_bytes())
    key.update(repr((np.__version__, radius, seed)).encode())

    def build():
        items = [(g, radius, seed, d) for d, g in enumerate(different)]
        packed = mapped(_packed, items, f"Finding the shortest ways in {len(items):,} layouts")
        sizes = np.array([len(items), *map(len, packed)], np.int64)
        cache.prune(PREFIX, MAX_FILES - 1, MAX_BYTES - sum(sizes[1:].tolist()))
        return b"".join([sizes.tobytes(), *packed])

    body, _ = cache.fetch(f"{PREFIX}{key.hexdigest()[:20]}", build)
    n = int(np.frombuffer(body, np.int64, 1)[0])
    ends = 8 * (n + 1) + np.frombuffer(body, np.int64, n + 1)[1:].cumsum()
    starts = [8 * (n + 1), *ends[:-1]]
    found = [_unpacked(body[start:end]) for start, end in zip(starts, ends, strict=True)]
    numbers = {id(g): number for number, g in enumerate(different)}
    return [found[numbers[id(g)]] for g in geometries]
