"""Goals of layouts, and the lengths of the shortest paths to them, computed once per layout and
cached.

D layouts, S spawn points and G goals per layout, H x W cells.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from megastep import cache, engine, geodesics
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.geodesics import CELL, Geodesics
from megastep.geometry import contents
from megastep.kernels.build.kernel_library import KERNELS
from megastep.modules import spawning

T = TypeVar("T")

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


class GoalFields:
    """The goals of a scenery's layouts, as :func:`~megastep.envs.pointgoal.pointgoal_step` reads
    them.

    Args:
        points: D arrays (G, 2) metres, the goals.
        fields: D arrays (G, H, W) float16 of at least 2 x 2 square cells, row 0 at the bottom:
            metres to each goal from the centre of a cell by the shortest path, infinite if there is
            none. Layouts may share an array.
        origins: D arrays (2,) metres, the centre of the first cell.
        spawns: D arrays (S, 2) metres, the spawn points.
        lengths: D arrays (S, G) metres, of the shortest paths from spawn points to goals.
        allowed: D arrays (S, G) bool, the goals that may be drawn; at least one per spawn point.
        cell: side of a cell in metres.
        device: where to put the tensors.

    Attributes:
        points: (D, G, 2) float32.
        spawns: (D, S, 2) float32.
        addresses: {field of PointgoalStepParams: address}.
    """

    IS_STATELESS = True  # nothing of it changes

    def __init__(
        self,
        points: Sequence[np.ndarray],
        fields: Sequence[np.ndarray],
        origins: Sequence[np.ndarray],
        spawns: Sequence[np.ndarray],
        lengths: Sequence[np.ndarray],
        allowed: Sequence[np.ndarray],
        cell: float = CELL,
        device: torch.device | str = "cpu",
    ):
        self.cell, self.n_layouts = cell, len(fields)
        self.n_goals, self.n_spawns = len(points[0]), len(spawns[0])
        is_allowed = np.stack(allowed)
        finite = np.where(is_allowed, np.stack(lengths), 0.0)  # of others they may be infinite
        distinct = {id(field): field for field in fields}
        ends = np.cumsum([field.size for field in distinct.values()])
        starts = {key: end - field.size for (key, field), end in zip(distinct.items(), ends)}
        arrays = dict(
            points=np.stack(points).astype(np.float32),
            origins=np.stack(origins).astype(np.float32),
            lengths=finite.astype(np.float32),
            fields=np.concatenate([field.reshape(-1) for field in distinct.values()]),
            starts=np.array([starts[id(field)] for field in fields], np.int64),
            shapes=np.array([field.shape[1:] for field in fields], np.int32),
            in_range=np.argsort(~is_allowed, axis=2, kind="stable").astype(np.int32),
            n_in_range=is_allowed.sum(2, dtype=np.int32),
        )
        self._tensors = {name: torch.from_numpy(a).to(device) for name, a in arrays.items()}
        self.points = self._tensors["points"]
        self.spawns = torch.from_numpy(np.stack(spawns).astype(np.float32)).to(device)
        self.device = self.points.device

    @property
    def addresses(self) -> dict[str, int]:
        return {name: tensor.data_ptr() for name, tensor in self._tensors.items()}


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
    n_bytes = [2 * N_GOALS * geodesics.n_cells(g) for g in geometries]  # of fields in fp16
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
    found = geodesics.geodesics(distinct, N_SPAWNS, N_GOALS, radius, generators, device)
    if torch.device(device).type == "cpu":
        found = _cached(found, distinct, radius, seed)
    by_id = dict(zip(map(id, distinct), found, strict=True))
    return [by_id[id(g)] for g in geometries]


def _cached(found, geometries, radius, seed) -> list[Geodesics]:
    """Returns the list of what the iterator `found` yields, from the cache if it holds it."""

    def build() -> dict[str, np.ndarray]:
        layouts = list(_with_progress(found, len(geometries)))
        rest = [name for name in Geodesics._fields if name != "fields"]
        arrays = {name: np.stack([getattr(layout, name) for layout in layouts]) for name in rest}
        shapes = np.array([layout.fields.shape for layout in layouts])
        flat = np.concatenate([layout.fields.reshape(-1) for layout in layouts])
        return dict(arrays, shapes=shapes, flat=flat)

    parts = *SOURCES, radius, seed, *contents(geometries)
    arrays = cache.arrays(PREFIX, parts, build, MAX_FILES, MAX_BYTES)
    shapes, flat = arrays.pop("shapes"), arrays.pop("flat")
    fields = np.split(flat, shapes.prod(1).cumsum()[:-1])
    shaped = [field.reshape(shape) for field, shape in zip(fields, shapes)]
    rest = [dict(zip(arrays, values)) for values in zip(*arrays.values())]
    return [Geodesics(fields=field, **parts) for field, parts in zip(shaped, rest, strict=True)]


def _with_progress(items: Iterable[T], total: int) -> Iterable[T]:
    """Returns an iterator over `items` that shows a progress bar on stderr, if they are many."""
    if total < MIN_PROGRESS:
        return items
    from rich.console import Console
    from rich.progress import track

    description = f"Computing the shortest paths in {total:,} layouts"
    return track(items, description, total, console=Console(stderr=True))
