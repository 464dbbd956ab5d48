"""Where agents are sent, and how far that is by the shortest way: found once per layout, and kept.

D layouts, S spawn points and G goals per layout.
"""

import io
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from megastep import cache, engine
from megastep.envs.pointgoal.geodesics import CELL, Geodesics, geodesics
from megastep.envs.pointgoal.goal_fields import GoalFields
from megastep.geometry import hashed
from megastep.modules import spawning
from megastep.workers import parallel_map

PREFIX = "geodesics-"  # of their files in the cache
MAX_FILES, MAX_BYTES = 64, 10**9  # of all of them
#: The cache is for these versions of them.
SOURCES = (
    Path(__file__),
    Path(__file__).with_name("geodesics.py"),
    Path(spawning.__file__),
)
N_GOALS = 16  # per layout
N_SPAWNS = 128


def goal_fields(
    geometries: Sequence[Any],
    core: Any,
    nearest: float = 1.0,
    furthest: float = 15.0,
    seed: int | None = None,
) -> GoalFields:
    """Goals and spawn points of the layouts of a core, and the ways between them: those are allowed
    that are ``nearest`` to ``furthest`` metres long.

    ``geometries`` are those the scenery was made from. ValueError, naming the geometry, if one has
    no goal in that range.
    """
    if not 0 <= nearest < furthest:
        raise ValueError(
            f"goals need 0 <= nearest < furthest metres, but {nearest:g} and {furthest:g} were "
            f"given"
        )
    seed, device = core.seed if seed is None else seed, core.device
    geometries = geometries[: len(core.scenery.layouts)]
    found = all_geodesics(geometries, core.agents.radius, seed)
    engine.fit(len(found), np.mean([one.fields.nbytes for one in found]), device, "layouts")
    spawns, lengths, allowed = zip(
        *[_in_range(one, g, nearest, furthest) for one, g in zip(found, geometries, strict=True)]
    )
    points, fields, origins = (
        [getattr(one, name) for one in found] for name in ("goals", "fields", "origin")
    )
    return GoalFields(points, fields, origins, spawns, lengths, allowed, CELL, device)


def _in_range(found, g, nearest, furthest):
    """Spawn points (S, 2) with a goal in range, lengths (S, G), and which are in range (S, G)."""
    allowed = (found.lengths >= nearest) & (found.lengths <= furthest)
    kept = allowed.any(1).nonzero()[0]
    if not len(kept):
        raise ValueError(
            f"geometry {g.id} has no goal from {nearest:g} to {furthest:g} m from where agents "
            f"spawn: its ways are {found.lengths.min():.1f} to {found.lengths.max():.1f} m long, "
            f"so allow others, or leave it out"
        )
    kept = np.resize(kept, len(found.spawns))
    return found.spawns[kept], found.lengths[kept], allowed[kept]


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
    for path in SOURCES:
        key.update(path.read_bytes())
    key.update(repr((np.__version__, radius, seed)).encode())

    def build():
        items = [(g, radius, seed, d) for d, g in enumerate(different)]
        packed = parallel_map(
            _packed, items, f"Finding the shortest ways in {len(items):,} layouts"
        )
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
