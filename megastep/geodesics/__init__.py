"""Shortest paths of an agent's disc between walls, in the visibility graph of homes, and random
goals and spawn points. A *field* holds the lengths to one goal from the centres of a grid's cells.

Corners of polygons around the ends of walls see each other (Lozano-Perez and Wesley 1979);
`kernels/shortest_paths.h` computes paths with the same bits on CPU and GPU. Every passage that is 5
mm wider than an agent is found, and no length is more than a body can walk.

D homes, W walls and V corners of all homes, S spawn points and G goals per home, P or K points, H x
W cells.
"""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from megastep.devices import threads
from megastep.dotdict import dotdict
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import BLOCK, launch
from megastep.modules.spawning import CLEARANCE, candidates

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
CELL = 0.1  # metres, of fields
SIDES = 16  # of the polygon around the end of a wall
INFLATION = 1.001  # of the radius, as in physics
SLACK = 5e-5  # metres between a path and the clearance that is tested, for rounding
MAX_GOALS, GROUP, KEPT = (LIBRARY.constants[name] for name in ("MAX_GOALS", "GROUP", "KEPT"))
GROUP_SIDE = 1.5  # metres: walls with their middles in one square are neighbours
STEP = 5e-3  # metres from a corner where it is tested if a path can turn there
TURN = 0.026  # radians of that turn
SPARE = 1.5  # times as many points are drawn as needed, as some may be in rooms without a door
#: Cells of the homes that are searched at once, per thread on a CPU, where signals are handled
#: between two searches. A cell takes 100 bytes, a wall as much as WALL cells.
CELLS_AT_ONCE = {"cpu": 125_000, "cuda": 10_000_000}
WALL = 20
#: Cells of one home: 100 m x 100 m take a CPU some seconds and 100 MB.
MAX_CELLS = 1_000_000


def _starts(counts) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)])


def _directions(angles) -> np.ndarray:
    return np.stack([np.cos(angles), np.sin(angles)], 1)


class PathGraph:
    """The walls of homes, and the corners where paths may bend, on a device.

    Args:
        geometries: D of them.
        radius: of the agents, in metres.
        device: where to compute.

    Attributes:
        origins: (D, 2) float32. All points are relative to these.
    """

    def __init__(self, geometries: Sequence[dotdict], radius: float, device: torch.device):
        self.geometries, self.device, self.radius = geometries, device, radius
        n_walls = np.array([len(g.walls) for g in geometries])
        firsts, home = _starts(n_walls)[:-1], np.repeat(np.arange(len(n_walls)), n_walls)
        walls = np.concatenate([g.walls for g in geometries]).astype(np.float64)
        low = np.minimum.reduceat(walls.min(1), firsts)
        high = np.maximum.reduceat(walls.max(1), firsts)
        self.origins = low.astype(np.float32)
        self.shapes = np.ceil((high - low) / CELL).astype(int)[:, ::-1] + 2  # (D, 2) rows, columns
        walls -= self.origins[home, None]
        self._group(walls, home, n_walls)
        self.tensors["corners"], self.corner_homes = torch.empty((6, 0)), torch.empty(0)
        self.tensors["corner_starts"] = torch.empty(0)
        self.tensors["corners"], self.corner_homes = self._find_corners(walls, home)
        homes = torch.arange(len(n_walls) + 1, dtype=torch.int32, device=device)
        starts = torch.searchsorted(self.corner_homes, homes)
        self.tensors["corner_starts"] = starts.int()
        self.links = self._link()

    def _group(self, walls, home, n_walls) -> None:
        """Sets walls (W, 2, 2), neighbours together, in groups with bounding boxes."""
        cells = (walls.mean(1) / GROUP_SIDE).astype(int)
        walls = walls[np.lexsort((cells[:, 0], cells[:, 1], home))].astype(np.float32)
        n_groups = -(-n_walls // GROUP)
        # the last group of a home is filled up with its last wall
        index = np.arange(GROUP * n_groups.sum()) - np.repeat(
            GROUP * _starts(n_groups)[:-1], GROUP * n_groups
        )
        index = np.minimum(index, np.repeat(n_walls - 1, GROUP * n_groups))
        walls = walls[index + np.repeat(_starts(n_walls)[:-1], GROUP * n_groups)]
        grouped = walls.reshape(-1, 2 * GROUP, 2)
        boxes = np.concatenate([grouped.min(1), grouped.max(1)], 1)
        self.n_groups = len(boxes)
        self.tensors = dict(
            walls=self.tensor(walls.reshape(-1, 4).T, np.float32),
            # groups are looked at GROUP at once, so some beyond the last one are read
            boxes=self.tensor(np.append(boxes.T, np.zeros(GROUP)), np.float32),
            group_starts=self.tensor(_starts(n_groups), np.int32),
        )

    def tensor(self, array, dtype) -> torch.Tensor:
        """Returns an array on the device."""
        return torch.from_numpy(np.ascontiguousarray(array, dtype)).to(self.device)

    def _params(self) -> bytes:
        inradius = INFLATION * self.radius + 2 * SLACK
        circumradius = inradius / np.cos(np.pi / SIDES)
        return LIBRARY.params.HomesParams(
            **self.tensors,
            n_groups=self.n_groups,
            n_corners=len(self.corner_homes),
            n_homes=len(self.geometries),
            n_threads=threads(),
            clearance=inradius - SLACK,
            rebate=(circumradius - inradius) * 2 * np.pi / SIDES,
        )

    # ---- The visibility graph ----

    def _find_corners(self, walls, home) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the corners of paths: columns (6, V) as in HomesParams, and their homes (V,)."""
        rows = np.column_stack([np.repeat(home, 2), walls.reshape(-1, 2)[:, ::-1]])
        rows = np.unique(rows, axis=0)  # (home, y, x) of each end
        owner, ends = rows[:, 0], rows[:, :0:-1]
        inradius, side = INFLATION * self.radius + 2 * SLACK, 2 * np.pi / SIDES
        angles = side * (np.arange(SIDES) + 0.5)
        # along the side before a corner and the one behind it, turned a little to the wall's end
        ahead = _directions(angles - side / 2 + np.pi / 2 + TURN)
        back = _directions(angles + side / 2 - np.pi / 2 - TURN)
        ends, owner = self.tensor(ends, np.float64), self.tensor(owner, np.int32)
        corner, fits = inradius / np.cos(side / 2) * _directions(angles), None
        for step in (0.0, STEP * ahead, STEP * back):
            points = (ends[:, None] + self.tensor(corner + step, np.float64)).view(-1, 2)
            candidates = torch.arange(len(points), device=self.device) if fits is None else fits
            clearances = self.clearances(points[candidates], owner[candidates // SIDES], inradius)
            fits = candidates[clearances >= inradius - SLACK]
        sides = [_directions(angles - side / 2), _directions(angles + side / 2)]
        sides = self.tensor(np.concatenate(sides, 1), np.float32)[fits % SIDES]
        corners = (ends[:, None] + self.tensor(corner, np.float64)).view(-1, 2)[fits]
        return torch.cat([corners.float(), sides], 1).T.contiguous(), owner[fits // SIDES]

    def clearances(self, points, home, most) -> torch.Tensor:
        """Returns the metres (P,) float32 from points (P, 2) to the nearest wall of their home, by
        its number (P,) int32; at most `most`.
        """
        clearances = torch.empty(len(points), device=self.device)
        launch(
            *(LIBRARY, "clearances", self.device, len(points)),
            homes=self._params(),
            points=points.float().contiguous(),
            home_index=home,
            clearances=clearances,
            most=most,
            n_points=len(points),
        )
        return clearances

    def _link(self) -> dict[str, torch.Tensor]:
        """Returns links between corners that see each other: starts (V + 1,), targets, metres."""
        v, device = len(self.corner_homes), self.device
        counts = torch.empty(v, dtype=torch.int32, device=device)
        kept = torch.empty((v, KEPT), dtype=torch.int32, device=device)
        always = dict(homes=self._params(), corner_homes=self.corner_homes, kept=kept)
        where = LIBRARY, "corner_links", device, v
        launch(*where, **always, counts=counts, starts=None, targets=None, metres=None)
        ends = counts.cumsum(0, dtype=torch.int32)
        n_links = int(ends[-1]) if v else 0
        links = dict(
            starts=torch.cat([torch.zeros_like(ends[:1]), ends]),
            targets=torch.empty(n_links, dtype=torch.int32, device=device),
            metres=torch.empty(n_links, device=device),
        )
        launch(*where, **always, counts=None, **links)
        return links

    # ---- Shortest paths ----

    def lengths(self, goals, points) -> torch.Tensor:
        """Returns the lengths of the shortest paths from points (D, K, 2) to goals (D, G, 2), as
        (D, G, K) float32. Infinite where there is no path.
        """
        counts = np.full(points.shape[0], points.shape[1])
        lengths = self._all_lengths(goals, counts, self.tensor(points, np.float32))
        return lengths.view(len(points), -1, points.shape[1])

    def fields(self, goals) -> list[np.ndarray]:
        """Returns the lengths of the shortest paths from all cells to goals (D, G, 2), as float16
        (G, H, W) of each home.
        """
        shapes = [(goals.shape[1], *shape) for shape in self.shapes.tolist()]
        lengths = self._all_lengths(goals, self.shapes.prod(1)).half().cpu().numpy()
        ends = np.prod(shapes, 1).cumsum()[:-1]
        return [field.reshape(s) for field, s in zip(np.split(lengths, ends), shapes)]

    def _all_lengths(self, goals, counts, points=None) -> torch.Tensor:
        """Returns lengths (P * G,) from points (P, 2), or centres of cells, to goals (D, G, 2)."""
        n_goals = goals.shape[1]
        if n_goals > MAX_GOALS:
            raise ValueError(f"{n_goals} goals per home: at most {MAX_GOALS} in one call")
        goals = self.tensor(goals, np.float32)
        distances = torch.empty((len(self.corner_homes), MAX_GOALS), device=self.device)
        launch(
            *(LIBRARY, "corner_distances", self.device, BLOCK * len(counts)),
            homes=self._params(),
            goals=goals,
            distances=distances,
            n_goals=n_goals,
            **self.links,
        )
        n_points = int(counts.sum())
        lengths = torch.empty(n_points * n_goals, device=self.device)
        launch(
            *(LIBRARY, "path_lengths", self.device, n_points),
            homes=self._params(),
            goals=goals,
            distances=distances,
            points=points,
            widths=self.tensor(self.shapes[:, 1], np.int32),
            point_starts=self.tensor(_starts(counts), np.int32),
            lengths=lengths,
            cell=CELL,
            n_points=n_points,
            n_goals=n_goals,
        )
        return lengths


class Geodesics(NamedTuple):
    """Goals, spawn points and shortest paths of one geometry, in metres."""

    origin: np.ndarray  # (2,) float32: the centre of the first cell
    fields: np.ndarray  # (G, H, W) float16: length to each goal or inf; row 0 at the bottom
    spawns: np.ndarray  # (S, 2) float32; every goal can be reached from each
    goals: np.ndarray  # (G, 2) float32
    lengths: np.ndarray  # (S, G) float32: of the shortest paths


def geodesics(
    geometries: Sequence[dotdict],
    n_spawns: int,
    n_goals: int,
    radius: float,
    generators: Sequence[np.random.Generator],
    device: torch.device | str = "cpu",
) -> Iterator[Geodesics]:
    """Draws ``n_spawns`` spawn points and up to MAX_GOALS goals from the largest connected part of
    each geometry, by its generator, and yields them with the shortest paths of agents of ``radius``
    metres between them, the same on any device. ValueError, naming the geometry, if it has no room
    for an agent, no walls or is too large.
    """
    device = torch.device(device)
    n_threads = threads() if device.type == "cpu" else 1
    for chunk in _chunks(geometries, n_threads * CELLS_AT_ONCE[device.type]):
        graph = PathGraph(geometries[chunk], radius, device)
        points = draw_points(graph, int(SPARE * (n_spawns + n_goals)), generators[chunk])
        goals, spawns = largest_part(graph, points, n_goals, n_spawns)
        lengths = graph.lengths(goals, spawns).cpu().numpy()
        fields = graph.fields(goals)
        for d, origin in enumerate(graph.origins):
            yield Geodesics(origin, fields[d], spawns[d] + origin, goals[d] + origin, lengths[d].T)


# ---- Goals and spawn points ----


def n_cells(g: dotdict) -> int:
    """Returns the number of cells in the grid of a geometry. ValueError, naming it, if it has no
    walls, or more than a million cells.
    """
    if not len(g.walls):
        raise ValueError(f"geometry {g.id} has no walls, but PointGoal needs homes with walls")
    size = g.walls.max((0, 1)) - g.walls.min((0, 1))
    n = int(np.prod(np.ceil(size / CELL) + 2))
    if n > MAX_CELLS:
        raise ValueError(
            f"geometry {g.id} is {size[0]:.0f} m x {size[1]:.0f} m, but PointGoal's homes have at "
            f"most {MAX_CELLS * CELL**2:,.0f} m2: use smaller ones, or check the unit"
        )
    return n


def _chunks(geometries, most) -> Iterator[slice]:
    """Yields slices of geometries whose grids have about `most` cells in all, at least one each."""
    first = total = 0
    for d, g in enumerate(geometries):
        if total >= most:
            yield slice(first, d)
            first, total = d, 0
        total += n_cells(g) + WALL * len(g.walls)
    yield slice(first, len(geometries))


def draw_points(graph: PathGraph, n: int, generators: Sequence[np.random.Generator]) -> np.ndarray:
    """Returns random points (D, n, 2) float32 in the rooms of a graph's homes, 5 cm clear of the
    walls. If fewer fit, they are repeated.
    """
    found = [np.empty((0, 2), np.float32)] * len(generators)
    streams = [candidates(*each) for each in zip(graph.geometries, itertools.repeat(n), generators)]
    lacking = range(len(found))
    while len(lacking):
        batches = {d: batch for d in lacking if (batch := next(streams[d], None)) is not None}
        if not batches:
            break
        drawn = np.stack([batch - graph.origins[d] for d, batch in batches.items()])
        drawn = drawn.astype(np.float32)
        home = graph.tensor(np.repeat([*batches], n), np.int32)
        clearances = graph.clearances(graph.tensor(drawn.reshape(-1, 2), np.float32), home, 1.0)
        fits = (clearances > graph.radius + CLEARANCE).cpu().numpy().reshape(-1, n)
        for d, points, fitting in zip(batches, drawn, fits):
            found[d] = np.concatenate([found[d], points[fitting]])[:n]
        lacking = [d for d in batches if len(found[d]) < n]
    for d, points in enumerate(found):
        if not len(points):
            raise ValueError(
                f"geometry {graph.geometries[d].id} has no point in a room that is "
                f"{graph.radius + CLEARANCE:.2f} m from every wall"
            )
    return np.stack([np.resize(points, (n, 2)) for points in found])


def largest_part(
    graph: PathGraph, points: np.ndarray, n_goals: int, n_spawns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns goals (D, n_goals, 2) and spawn points (D, n_spawns, 2): the first of points (D, K,
    2) in the connected part of each home that holds most of them.
    """
    n_homes, n_points = points.shape[:2]
    homes_range = np.arange(n_homes)[:, None]
    largest = np.zeros((n_homes, n_points), bool)
    unknown = np.ones((n_homes, n_points), bool)  # points in parts that were not measured yet
    while (unknown.sum(1) > largest.sum(1)).any():
        probes = np.argsort(~unknown, 1, kind="stable")[:, :MAX_GOALS]
        lengths = graph.lengths(points[homes_range, probes], points)
        parts = lengths.isfinite().cpu().numpy()  # (D, probes, K)
        parts &= unknown[homes_range, probes][:, :, None]
        best = parts[homes_range[:, 0], parts.sum(2).argmax(1)]
        larger = best.sum(1) > largest.sum(1)
        largest[larger] = best[larger]
        unknown &= ~parts.any(1)
    order = np.argsort(~largest, 1, kind="stable")
    counts = largest.sum(1)[:, None]
    goals = order[homes_range, np.arange(n_goals) % np.minimum(counts, n_goals)]
    n_left = np.where(counts > n_goals, counts - n_goals, counts)
    spawns = np.where(counts > n_goals, n_goals, 0) + np.arange(n_spawns) % n_left
    return points[homes_range, goals], points[homes_range, order[homes_range, spawns]]
