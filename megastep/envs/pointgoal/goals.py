"""Goals of layouts, and the lengths of the shortest paths to them. D layouts, S spawn points and G
goals per layout, H x W cells.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from megastep import cache, engine, geodesics
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.geodesics import Geodesics
from megastep.geometry import contents
from megastep.kernels.build.kernel_library import KERNELS
from megastep.modules import spawning

PREFIX = "geodesics-"  # of the cached files
MAX_FILES, MAX_BYTES = 64, 10**9  # of all cached files together
MIN_PROGRESS = 48  # layouts; fewer take less than a second or two
#: Sources that the results depend on: a change invalidates the cache.
SOURCES = (
    Path(__file__),
    *sorted(Path(geodesics.__file__).parent.glob("**/*.[hcp]*")),
    *sorted((KERNELS / "common").glob("*.h")),
    Path(spawning.__file__),
)
N_GOALS = 16  # per layout
N_SPAWNS = 128


class GoalFields(NamedTuple):
    """The goals of a scenery's layouts, as the kernel reads them."""

    IS_STATELESS = True  # nothing of it changes

    points: torch.Tensor  # (D, G, 2) float32 metres, the goals
    origins: torch.Tensor  # (D, 2) float32 metres, the centre of the first cell
    lengths: torch.Tensor  # (D, S, G) float32 metres, from spawn points by the shortest path
    #: float16 metres to each goal from the centres of a layout's (G, H, W) cells, row 0 at the
    #: bottom, by the shortest path; infinite if there is none. Layouts may share them.
    fields: torch.Tensor
    starts: torch.Tensor  # (D,) int64, of each layout's fields
    shapes: torch.Tensor  # (D, 2) int32, (H, W)
    in_range: torch.Tensor  # (D, S, G) int32, goals; first those that may be drawn
    n_in_range: torch.Tensor  # (D, S) int32, how many these are


def packed(
    layouts: Sequence[Geodesics], allowed: Sequence[np.ndarray], device: torch.device
) -> GoalFields:
    """Returns the goals of layouts; (S, G) bool may be drawn, at least one per spawn point."""
    fields = [layout.fields for layout in layouts]
    points, origins, lengths = (
        np.stack([getattr(layout, name) for layout in layouts])
        for name in ("goals", "origin", "lengths")
    )
    is_allowed = np.stack(allowed)
    distinct = {id(field): field for field in fields}
    ends = np.cumsum([field.size for field in distinct.values()])
    starts = {key: end - field.size for (key, field), end in zip(distinct.items(), ends)}
    arrays = (
        points.astype(np.float32),
        origins.astype(np.float32),
        np.where(is_allowed, lengths, 0.0).astype(np.float32),  # of others they may be infinite
        np.concatenate([field.reshape(-1) for field in distinct.values()]),
        np.array([starts[id(field)] for field in fields], np.int64),
        np.array([field.shape[1:] for field in fields], np.int32),
        np.argsort(~is_allowed, axis=2, kind="stable").astype(np.int32),
        is_allowed.sum(2, dtype=np.int32),
    )  # as the fields of GoalFields
    return GoalFields(*(torch.from_numpy(array).to(device) for array in arrays))


def goal_fields(
    geometries: Sequence[dotdict], core: Core, nearest: float = 1.0, furthest: float = 15.0
) -> tuple[GoalFields, torch.Tensor]:
    """Returns the goals of a core's layouts, by shortest paths of ``nearest`` to ``furthest``
    metres, and (D, S, 2) float32, spawn points from which there are some.

    Raises:
        ValueError: naming the geometry, if one has no goal in that range, no walls or is too large.
        EngineError: if the shortest paths of all layouts do not fit into memory.
    """
    if not 0 <= nearest < furthest:
        raise ValueError(
            f"goals need 0 <= nearest < furthest metres, but {nearest:g} and {furthest:g} were "
            f"given"
        )
    geometries, device = spawning.of_layouts(geometries, core), core.device
    n_bytes = [2 * N_GOALS * geodesics.n_cells(g) for g in geometries]  # of fields in fp16
    engine.fit(len(geometries), float(np.mean(n_bytes)), device, "layouts")
    layouts = all_geodesics(geometries, core.agents.radius, core.seed, device)
    for d, (layout, g) in enumerate(zip(layouts, geometries, strict=True)):
        indices = _in_range(layout, nearest, furthest).any(1).nonzero()[0]
        if not len(indices):
            raise ValueError(
                f"geometry {g.id} has no goal from {nearest:g} to {furthest:g} m from where agents "
                f"spawn: its shortest paths are {layout.lengths.min():.1f} to "
                f"{layout.lengths.max():.1f} m long. Change nearest or furthest, or leave it out"
            )
        indices = np.resize(indices, len(layout.spawns))
        spawns, lengths = layout.spawns[indices], layout.lengths[indices]
        layouts[d] = layout._replace(spawns=spawns, lengths=lengths)
    allowed = [_in_range(layout, nearest, furthest) for layout in layouts]
    spawns = np.stack([layout.spawns for layout in layouts]).astype(np.float32)
    return packed(layouts, allowed, device), torch.from_numpy(spawns).to(device)


def check_doors(geometries: Sequence[dotdict], radius: float) -> None:
    """Raises ValueError if a robot of a radius fits through none of a home's known openings."""
    for g in {id(g): g for g in geometries}.values():
        gaps = np.concatenate([g.get(name, np.empty((0, 2, 2))) for name in ("doors", "openings")])
        widths = np.linalg.norm(gaps[:, 1] - gaps[:, 0], axis=1)
        if len(widths) and widths.max() <= 2 * radius:
            raise ValueError(
                f"a robot of radius={radius:g} m fits through no door of geometry {g.id}: it needs "
                f"more than {2 * radius:g} m, and the widest has {widths.max():.2f} m"
            )


def _in_range(layout, nearest, furthest) -> np.ndarray:
    return (layout.lengths >= nearest) & (layout.lengths <= furthest)


# ---- The cache ----


def all_geodesics(
    geometries: Sequence[dotdict], radius: float, seed: int, device: torch.device | str = "cpu"
) -> list[Geodesics]:
    """Returns the geodesics of each geometry, the same on any device; a CPU caches them."""
    distinct = list({id(g): g for g in geometries}.values())
    generators = [np.random.Generator(np.random.Philox([seed, d])) for d in range(len(distinct))]
    found = geodesics.geodesics(distinct, N_SPAWNS, N_GOALS, radius, generators, device)
    if torch.device(device).type == "cpu":
        found = _cached(found, distinct, radius, seed)
    by_id = dict(zip(map(id, distinct), found, strict=True))
    return [by_id[id(g)] for g in geometries]


def _cached(found, geometries, radius, seed) -> list[Geodesics]:
    """Returns the list of what the iterator `found` yields, from the cache if it holds it."""

    def build() -> list[dict]:
        from rich.console import Console
        from rich.progress import track

        n = len(geometries)
        description = f"Computing the shortest paths in {n:,} layouts"
        bar: dict = dict(console=Console(stderr=True), disable=n < MIN_PROGRESS)
        return [layout._asdict() for layout in track(found, description, n, **bar)]

    parts = *SOURCES, radius, seed, *contents(geometries)
    return [Geodesics(**g) for g in cache.records(PREFIX, parts, build, MAX_FILES, MAX_BYTES)]
