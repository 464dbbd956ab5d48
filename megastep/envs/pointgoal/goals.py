"""Goals and shortest paths of layouts, computed once per layout and cached.

D layouts, S spawn points and G goals per layout.
"""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from megastep import cache, engine
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.envs.pointgoal.geodesics import CELL, Geodesics, geodesics, n_cells
from megastep.envs.pointgoal.goal_fields import GoalFields
from megastep.geodesics import path_graph
from megastep.geometry import content_hash
from megastep.kernels.build.kernel_library import KERNELS
from megastep.modules import spawning

T = TypeVar("T")

PREFIX = "geodesics-"  # of the cached files
MAX_FILES, MAX_BYTES = 64, 10**9  # of all cached files together
MIN_PROGRESS = 48  # layouts; fewer take less than a second or two
#: Sources that the results depend on: a change invalidates the cache.
SOURCES = (
    Path(__file__),
    Path(__file__).with_name("geodesics.py"),
    Path(path_graph.__file__),
    *sorted(path_graph.LIBRARY.folder.glob("*.[hc]*")),
    *sorted((KERNELS / "common").glob("*.h")),
    Path(spawning.__file__),
)
N_GOALS = 16  # per layout
N_SPAWNS = 128
#: Fields of Geodesics whose shape is the same for all layouts.
REST = {
    "origin": (2,),
    "spawns": (N_SPAWNS, 2),
    "goals": (N_GOALS, 2),
    "lengths": (N_SPAWNS, N_GOALS),
}


def goal_fields(
    geometries: Sequence[dotdict],
    core: Core,
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
        ValueError: naming the geometry, if one has no goal in that range, no walls or is too large.
        EngineError: if the shortest paths of all layouts do not fit into memory.
    """
    if not 0 <= nearest < furthest:
        raise ValueError(
            f"goals need 0 <= nearest < furthest metres, but {nearest:g} and {furthest:g} were "
            f"given"
        )
    seed = core.seed if seed is None else seed
    device = core.device
    geometries = geometries[: len(core.scenery.layouts)]
    n_bytes = [2 * N_GOALS * n_cells(g) for g in geometries]  # of fields in fp16
    engine.fit(len(geometries), float(np.mean(n_bytes)), device, "layouts")
    layouts = all_geodesics(geometries, core.agents.radius, seed, device)
    spawns, lengths, allowed = zip(
        *[_in_range(*pair, nearest, furthest) for pair in zip(layouts, geometries, strict=True)]
    )
    points, fields, origins = (
        [getattr(layout, name) for layout in layouts] for name in ("goals", "fields", "origin")
    )
    return GoalFields(points, fields, origins, spawns, lengths, allowed, CELL, device)


def _in_range(layout, g, nearest, furthest) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def all_geodesics(
    geometries: Sequence[dotdict], radius: float, seed: int, device: torch.device | str = "cpu"
) -> list[Geodesics]:
    """Returns the geodesics of each geometry.

    A GPU computes them in less time than a file takes to read. A CPU takes some seconds for 512
    homes: it shows a progress bar and caches them.

    Args:
        geometries: floor plans. The same object may occur several times.
        radius: of the agents, in metres.
        seed: of goals and spawn points.
        device: where to compute. The results do not depend on it.
    """
    distinct = list({id(g): g for g in geometries}.values())
    generators = [np.random.Generator(np.random.Philox([seed, d])) for d in range(len(distinct))]
    found = geodesics(distinct, N_SPAWNS, N_GOALS, radius, generators, device)
    if torch.device(device).type == "cpu":
        found = _cached(found, distinct, radius, seed)
    by_id = dict(zip(map(id, distinct), found, strict=True))
    return [by_id[id(g)] for g in geometries]


def _cached(found, geometries, radius, seed) -> list[Geodesics]:
    """Returns the list of what the iterator `found` yields, from the cache if it holds it."""
    key = content_hash(geometries)
    for path in SOURCES:
        key.update(path.read_bytes())
    key.update(repr((np.__version__, radius, seed)).encode())

    def build() -> bytes:
        layouts = list(_with_progress(found, len(geometries)))
        shapes = np.array([layout.fields.shape for layout in layouts], np.int64)
        parts = [np.stack([getattr(layout, name) for layout in layouts]) for name in REST]
        parts = [shapes, *parts, *(layout.fields for layout in layouts)]
        cache.prune(PREFIX, MAX_FILES - 1, MAX_BYTES - sum(part.nbytes for part in parts))
        return b"".join(np.ascontiguousarray(part).data for part in parts)

    body, _ = cache.fetch(f"{PREFIX}{key.hexdigest()[:20]}", build)
    n, start = len(geometries), 0

    def read(shape, dtype) -> np.ndarray:
        nonlocal start
        array = np.frombuffer(body, dtype, math.prod(shape), start).reshape(shape)
        start += array.nbytes
        return array

    shapes = read((n, 3), np.int64)
    rest = [read((n, *shape), np.float32) for shape in REST.values()]
    fields = [read(shape, np.float16) for shape in shapes.tolist()]
    return [
        Geodesics(fields=field, **dict(zip(REST, values)))
        for field, *values in zip(fields, *rest, strict=True)
    ]


def _with_progress(items: Iterable[T], total: int) -> Iterable[T]:
    """Returns an iterator over `items` that shows a progress bar on stderr, if they are many."""
    if total < MIN_PROGRESS:
        return items
    from rich.console import Console
    from rich.progress import track

    description = f"Computing the shortest paths in {total:,} layouts"
    return track(items, description, total, console=Console(stderr=True))
