"""Goals and shortest paths of layouts, computed once per layout and cached.

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
from megastep.geometry import content_hash
from megastep.modules import spawning
from megastep.workers import parallel_map

PREFIX = "geodesics-"  # of the cached files
MAX_FILES, MAX_BYTES = 64, 10**9  # of all cached files together
#: Sources that the results depend on: a change invalidates the cache.
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
    """Returns the goals of a core's layouts.

    Args:
        geometries: those that the scenery was made from.
        core: with the scenery and the agents.
        nearest: minimum length of the shortest path to a goal, in metres.
        furthest: maximum length of the shortest path to a goal, in metres.
        seed: of goals and spawn points. Default: the core's.

    Raises:
        ValueError: naming the geometry, if one has no goal in that range.
    """
    if not 0 <= nearest < furthest:
        raise ValueError(
            f"goals need 0 <= nearest < furthest metres, but {nearest:g} and {furthest:g} were "
            f"given"
        )
    seed, device = core.seed if seed is None else seed, core.device
    geometries = geometries[: len(core.scenery.layouts)]
    layouts = all_geodesics(geometries, core.agents.radius, seed)
    mean_bytes = np.mean([layout.fields.nbytes for layout in layouts])
    engine.fit(len(layouts), mean_bytes, device, "layouts")
    spawns, lengths, allowed = zip(
        *[_in_range(*pair, nearest, furthest) for pair in zip(layouts, geometries, strict=True)]
    )
    points, fields, origins = (
        [getattr(layout, name) for layout in layouts] for name in ("goals", "fields", "origin")
    )
    return GoalFields(points, fields, origins, spawns, lengths, allowed, CELL, device)


def _in_range(layout, g, nearest, furthest):
    """Returns spawn points (S, 2) with a goal in range, the lengths (S, G) of their shortest paths,
    and (S, G) bool, true where a length is in range.
    """
    allowed = (layout.lengths >= nearest) & (layout.lengths <= furthest)
    indices = allowed.any(1).nonzero()[0]
    if not len(indices):
        raise ValueError(
            f"geometry {g.id} has no goal from {nearest:g} to {furthest:g} m from where agents "
            f"spawn: its shortest paths are {layout.lengths.min():.1f} to "
            f"{layout.lengths.max():.1f} m long. Change nearest or furthest, or leave it out"
        )
    indices = np.resize(indices, len(layout.spawns))
    return layout.spawns[indices], layout.lengths[indices], allowed[indices]


# ---- The cache ----


def _packed(item):
    """Returns a geometry's geodesics as bytes.

    Fields are stored as differences between neighbours, which compress well.
    """
    g, radius, seed, d = item
    random = np.random.Generator(np.random.Philox([seed, d]))
    result = geodesics(g, N_SPAWNS, N_GOALS, radius, random)
    differences = np.diff(result.fields.view(np.uint16), axis=2, prepend=np.uint16(0))
    file = io.BytesIO()
    np.savez(file, **result._replace(fields=differences)._asdict())
    return zlib.compress(file.getvalue(), 1)


def _unpacked(body):
    with np.load(io.BytesIO(zlib.decompress(body))) as arrays:
        packed = Geodesics(**arrays)
    cells = np.cumsum(packed.fields, axis=2, dtype=np.uint16)
    return packed._replace(fields=cells.view(np.float16))


def all_geodesics(geometries: Sequence[Any], radius: float, seed: int) -> list[Geodesics]:
    """Returns the geodesics of each geometry, from the cache if possible.

    Otherwise all CPU cores compute them, with a progress bar if that takes long.

    Args:
        geometries: floor plans. The same object may occur several times.
        radius: of the agents, in metres.
        seed: of goals and spawn points.
    """
    distinct = list({id(g): g for g in geometries}.values())
    key = content_hash(distinct)
    for path in SOURCES:
        key.update(path.read_bytes())
    key.update(repr((np.__version__, radius, seed)).encode())

    def build():
        items = [(g, radius, seed, d) for d, g in enumerate(distinct)]
        packed = parallel_map(
            _packed, items, f"Computing the shortest paths in {len(items):,} layouts"
        )
        sizes = np.array([len(items), *map(len, packed)], np.int64)
        cache.prune(PREFIX, MAX_FILES - 1, MAX_BYTES - sum(sizes[1:].tolist()))
        return b"".join([sizes.tobytes(), *packed])

    body, _ = cache.fetch(f"{PREFIX}{key.hexdigest()[:20]}", build)
    n = int(np.frombuffer(body, np.int64, 1)[0])
    ends = 8 * (n + 1) + np.frombuffer(body, np.int64, n + 1)[1:].cumsum()
    starts = [8 * (n + 1), *ends[:-1]]
    results = [_unpacked(body[start:end]) for start, end in zip(starts, ends, strict=True)]
    numbers = {id(g): number for number, g in enumerate(distinct)}
    return [results[numbers[id(g)]] for g in geometries]
