"""Random goals and spawn points of homes, and the shortest paths between them. A *field* holds the
lengths to one goal from the centres of a grid's cells.

D homes, S spawn points and G goals per home, K points, H x W cells.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from megastep.devices import threads
from megastep.dotdict import dotdict
from megastep.geodesics.path_graph import CELL, MAX_GOALS, PathGraph
from megastep.modules.spawning import CLEARANCE, candidates

SPARE = 1.5  # times as many points are drawn as needed, as some may be in rooms without a door
#: Cells of the homes that are searched at once, per thread on a CPU, where signals are handled
#: between two searches. A cell takes 100 bytes, a wall as much as WALL cells.
CELLS_AT_ONCE = {"cpu": 125_000, "cuda": 10_000_000}
WALL = 20
#: Cells of one home: 100 m x 100 m take a CPU some seconds and 100 MB.
MAX_CELLS = 1_000_000


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
