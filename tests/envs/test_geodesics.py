"""Shortest paths against an oracle: by hand, and by a visibility graph with exact distances between
segments, which shares no code with the module.
"""

import heapq
import itertools
import math

import numpy as np
import pytest

from megastep import engine, geometry, toys
from megastep.dotdict import dotdict
from megastep.envs.pointgoal import geodesics as module
from megastep.envs.pointgoal.geodesics import CELL, geodesics
from megastep.geometries import sample
from megastep.modules.spawning import distances

RADIUS = engine.AGENT_RADIUS


def geodesics_of(g, n_spawns=24, n_goals=4, seed=1):
    return geodesics(g, n_spawns, n_goals, RADIUS, np.random.Generator(np.random.Philox(seed)))


def read(result, points):
    """(P, G): the fields interpolated at points, by a loop."""
    out = np.full((len(points), len(result.fields)), np.nan)
    for p, (x, y) in enumerate((points.astype(float) - result.origin) / CELL):
        i, j = int(y), int(x)
        up, right = y - i, x - j
        corners = result.fields[:, i : i + 2, j : j + 2].astype(float)
        weights = np.outer([1 - up, up], [1 - right, right])
        known = np.isfinite(corners)
        out[p] = np.where(known, corners, 0).reshape(len(corners), -1) @ weights.ravel()
        out[p] /= (known * weights).sum((1, 2))
    return out


# ---- The oracle ----


def gap(p, q, walls):
    """Metres between the segment p-q and the nearest of walls (M, 2, 2); 0 if they cross."""
    ends = np.concatenate([distances(np.stack([p, q]), walls)])
    way = np.stack([p, q])[None]
    nearest = min(ends.min(), distances(walls.reshape(-1, 2), way).min())

    def side(a, b, c):
        return np.sign((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0])

    a, b = walls[:, 0], walls[:, 1]
    crosses = (side(a, b, p) * side(a, b, q) < 0) & (side(p, q, a) * side(p, q, b) < 0)
    return 0.0 if crosses.any() else nearest


def shortest(walls, starts, goals, radius, n_around=16):
    """Returns the lengths (S, G) of the shortest polylines that stay `radius` away from all walls.

    Dijkstra's algorithm over starts, goals and the corners of polygons around the ends of walls.
    """
    walls = walls.astype(float)
    around = 2 * math.pi * (np.arange(n_around) + 0.5) / n_around
    ring = (
        (radius + 1e-6)
        / math.cos(math.pi / n_around)
        * np.stack([np.cos(around), np.sin(around)], 1)
    )
    corners = (np.unique(walls.reshape(-1, 2), axis=0)[:, None] + ring).reshape(-1, 2)
    corners = corners[distances(corners, walls) >= radius]
    nodes = np.concatenate([starts, goals, corners])
    ways = {}

    def way(i, j):
        key = min(i, j), max(i, j)
        if key not in ways:
            free = gap(nodes[i], nodes[j], walls) >= radius - 1e-9
            ways[key] = float(np.hypot(*(nodes[i] - nodes[j]))) if free else None
        return ways[key]

    out = np.full((len(starts), len(goals)), np.inf)
    for g in range(len(goals)):
        best, done = {len(starts) + g: 0.0}, set()
        queue, wanted = [(0.0, len(starts) + g)], set(range(len(starts)))
        while queue and wanted:
            metres, node = heapq.heappop(queue)
            if node in done:
                continue
            done.add(node)
            wanted.discard(node)
            if node < len(starts):
                out[node, g] = metres
                continue
            for other in range(len(nodes)):
                if other in done or len(starts) <= other < len(starts) + len(goals):
                    continue
                if metres + np.hypot(*(nodes[node] - nodes[other])) < best.get(other, np.inf):
                    step = way(node, other)
                    if step is not None and metres + step < best.get(other, np.inf):
                        best[other] = metres + step
                        heapq.heappush(queue, (best[other], other))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("source, n", [("homes", 8), ("bench", 2), ("maze", 2)])
def test_match_a_visibility_graph_in_many_homes(source, n):
    """The oracle's polygons lie outside of the arcs that an agent walks, by 2 % of an arc; the
    module's lie inside, by a few millimetres.
    """
    for g in sample(source, n, split="test"):
        check_against_oracle(g)


def test_match_a_visibility_graph_in_a_home():
    check_against_oracle(sample("homes", 1, split="test")[0])


def check_against_oracle(g):
    result = geodesics_of(g)
    starts = result.spawns[:3]
    oracle = shortest(g.walls, starts, result.goals, RADIUS)
    lengths = result.lengths[:3]
    where = f"geometry {g.id}: {lengths} {oracle}"
    assert np.isfinite(oracle).all() and (lengths <= 1.003 * oracle + 2e-3).all(), where
    assert (lengths >= 0.985 * oracle - 2e-2).all(), where
    fields = read(result, starts)
    assert (fields >= 0.995 * oracle - 0.05).all(), where  # of cells, so not shorter
    assert (fields <= 1.1 * oracle + 0.25).all(), where


# ---- By hand ----


def room(*walls, width=6.0, height=4.0, id=7):
    """A room with its lower-left corner at (1, 1), and walls in it, in its own coordinates."""
    corners = [(0, 0), (width, 0), (width, height), (0, height)]
    outer = list(zip(corners, [*corners[1:], corners[0]]))
    lines = np.array([*outer, *walls], float) + 1
    masks = geometry.masks(lines, [np.array(corners, float) + 1])
    return dotdict(
        id=id, walls=lines.astype(np.float32), lights=np.ones((1, 2)), masks=masks, res=geometry.RES
    )


def test_path_in_an_empty_room_is_straight():
    result = geodesics_of(toys.box(5))
    straight = np.hypot(*np.moveaxis(result.spawns[:, None] - result.goals, -1, 0))
    np.testing.assert_allclose(result.lengths, straight, rtol=1e-5)
    assert (distances(result.goals.astype(float), toys.box(5).walls) > RADIUS + 0.05).all()


def test_path_around_a_wall_is_two_tangents_and_an_arc():
    """A wall from the middle of the southern side reaches two metres into a room of 6 x 4 m."""
    g = room(((3, 0), (3, 2)))
    result, end, n = geodesics_of(g, 60, 40), np.array([4.0, 3.0]), 0
    for s, t in itertools.product(range(60), range(40)):
        a, b = result.spawns[s] - end, result.goals[t] - end
        if a[0] * b[0] > 0 or max(a[1], b[1]) > -0.3:
            continue  # on one side, or high enough to see each other
        reach = [np.sqrt(p @ p - RADIUS**2) for p in (a, b)]
        turn = math.acos(a @ b / np.hypot(*a) / np.hypot(*b))
        upward = 2 * math.pi - turn  # round the end, not through the wall
        arc = upward - sum(math.acos(RADIUS / np.hypot(*p)) for p in (a, b))
        assert result.lengths[s, t] == pytest.approx(sum(reach) + RADIUS * arc, abs=1e-2)
        n += 1
    assert n > 100


def test_paths_take_gaps_wider_than_the_agent():
    """A wall across the room with a gap at its northern end. The disc is 0.212 m wide."""
    across = {gap: room(((3, 0), (3, 4 - gap))) for gap in (0.15, 0.19, 0.45)}
    for gap_, open_ in ((0.15, False), (0.19, False), (0.45, True)):
        result = geodesics_of(across[gap_], 100, 16)
        sides = {bool(x > 4) for x in np.concatenate([result.spawns, result.goals])[:, 0]}
        assert len(sides) == (2 if open_ else 1), gap_
        assert np.isfinite(result.lengths).all()


def test_goals_are_in_the_largest_connected_part():
    result = geodesics_of(room(((2, 0), (2, 4))), 50, 16)
    assert (result.spawns[:, 0] > 3).all() and (result.goals[:, 0] > 3).all()


def test_fields_keep_the_agents_radius_from_walls():
    """Cells closer to a wall hold a neighbour's distance plus one cell, or infinity."""
    g = sample("homes", 1)[0]
    result = geodesics_of(g)
    _, height, width = result.fields.shape
    rows, columns = np.mgrid[:height, :width].reshape(2, -1)
    centres = result.origin + CELL * np.stack([columns, rows], 1)
    near = (distances(centres, g.walls.astype(float)) < RADIUS - 1e-6).reshape(height, width)
    fields = result.fields.astype(float)
    lowest = np.pad(fields, ((0, 0), (1, 1), (1, 1)), constant_values=np.inf)
    around = np.minimum.reduce(
        [lowest[:, 2:, 1:-1], lowest[:, :-2, 1:-1], lowest[:, 1:-1, 2:], lowest[:, 1:-1, :-2]]
    )
    known = near & np.isfinite(fields)
    assert known.any() and np.isfinite(fields[:, ~near]).mean() > 0.5
    assert (fields[known] >= around[known] + CELL - 0.02).all(), "in half precision"


def test_seeds_repeat_and_differ():
    g = sample("homes", 1)[0]
    a, b, c = geodesics_of(g), geodesics_of(g), geodesics_of(g, seed=2)
    assert all((x == y).all() for x, y in zip(a, b)) and not (a.goals == c.goals).all()


def test_moves_pass_free_cells_only():
    free = np.ones((5, 7), bool)
    free[2, 3] = False
    numbers, starts, ends, metres = module._graph(free)
    cells = np.argwhere(free)
    assert numbers[2, 3] == -1 and (numbers[tuple(cells.T)] == np.arange(34)).all()
    apart = cells[ends] - cells[starts]
    np.testing.assert_allclose(metres, CELL * np.hypot(*apart.T))
    beside = {frozenset(map(tuple, cells[[s, e]])) for s, e in zip(starts, ends)}
    assert frozenset([(1, 3), (2, 4)]) not in beside, "cuts the corner of the cell"
    assert frozenset([(1, 2), (2, 4)]) not in beside and frozenset([(0, 2), (2, 3)]) not in beside
    assert frozenset([(0, 0), (1, 2)]) in beside and frozenset([(3, 3), (4, 1)]) in beside
