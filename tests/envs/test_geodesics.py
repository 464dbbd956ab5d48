"""Shortest paths against an oracle: by hand; by a visibility graph with exact distances between
segments, which shares no code with the module; and by bodies that walk the oracle's paths.
"""

import heapq
import itertools
import math

import numpy as np
import pytest
import torch

from megastep import core, engine, geometry, scene, toys
from megastep.dotdict import dotdict
from megastep.geodesics import CELL, geodesics
from megastep.geometries import sample
from megastep.modules.spawning import distances

RADIUS = engine.AGENT_RADIUS
WIDTH = 2 * RADIUS
TOUCH = 1.001 * RADIUS  # where physics stops a body


def geodesics_of(g, n_spawns=24, n_goals=4, seed=1, device="cpu"):
    generators = [np.random.Generator(np.random.Philox(seed))]
    (result,) = geodesics([g], n_spawns, n_goals, RADIUS, generators, device)
    return result


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
        total = (known * weights).sum((1, 2))
        out[p] = np.divide(out[p], total, out=np.full(len(total), np.nan), where=total > 0)
    return out


# ---- The oracle ----


def gaps(p, points, walls):
    """(K,): metres between the segments from p to points (K, 2) and the nearest of walls (M, 2, 2);
    0 if they cross.
    """
    across = points - p  # (K, 2)
    ends = walls.reshape(-1, 2) - p  # (2M, 2)
    length2 = np.maximum((across**2).sum(1), 1e-12)
    along = np.clip(across @ ends.T / length2[:, None], 0, 1)  # (K, 2M)
    apart = np.hypot(*np.moveaxis(ends - along[..., None] * across[:, None], -1, 0)).min(1)
    nearest = np.minimum(apart, np.minimum(distances(p[None], walls), distances(points, walls)))

    def side(a, b, c):
        return np.sign((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0])

    a, b, q = walls[:, 0], walls[:, 1], points[:, None]
    crosses = (side(a, b, p) * side(a, b, q) < 0) & (side(p, q, a) * side(p, q, b) < 0)
    return np.where(crosses.any(1), 0.0, nearest)


def shortest(walls, starts, goals, radius, n_around=16):
    """Returns the lengths (S, G) of the shortest polylines that stay `radius` away from all walls,
    and for each goal the polylines from the starts, lists of points.

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
    fitting = np.arange(len(starts) + len(goals), len(nodes))
    others = np.concatenate([np.arange(len(starts)), fitting])
    steps = {}  # node: the metres to all others, infinite if it does not see them

    out, paths = np.full((len(starts), len(goals)), np.inf), []
    for g in range(len(goals)):
        best, done, towards = {len(starts) + g: 0.0}, set(), {}
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
            if node not in steps:
                straight = np.hypot(*(nodes[others] - nodes[node]).T)
                free = gaps(nodes[node], nodes[others], walls) >= radius - 1e-9
                steps[node] = np.where(free, straight, np.inf)
            for other, step in zip(others.tolist(), steps[node].tolist()):
                if metres + step < best.get(other, np.inf):
                    best[other], towards[other] = metres + step, node
                    heapq.heappush(queue, (best[other], other))
        paths.append([])
        for start in range(len(starts)):
            route = [start]
            while route[-1] in towards:
                route.append(towards[route[-1]])
            paths[g].append(nodes[route])
    return out, paths


def check_against_oracle(g, n_starts=3, n_around=16):
    """Our lengths lie below the oracle's, whose polygons lie outside of the arcs that a body walks,
    and which a body does walk.
    """
    result = geodesics_of(g)
    starts = result.spawns[:n_starts].astype(float)
    # a hair more than where a body touches a wall, for the rounding of its float coordinates
    oracle, paths = shortest(g.walls, starts, result.goals.astype(float), TOUCH + 1e-4, n_around)
    lengths = result.lengths[:n_starts]
    where = f"geometry {g.id}: {lengths} {oracle}"
    assert np.isfinite(oracle).all() and (lengths <= oracle + 1e-4).all(), where
    assert (lengths >= 0.99 * oracle - 5e-3).all(), where
    assert np.abs(read(result, starts) - lengths).max() < 0.03, where
    for routes in paths:
        for route in routes:
            walk(g, route)


def walk(g, route):
    """Makes a body walk a polyline in the engine, at most 0.4 m a step; fails if it touches."""
    stops = [route[0]]
    for start, end in itertools.pairwise(route):
        n = math.ceil(np.hypot(*(end - start)) / 0.4) or 1
        stops += [start + (end - start) * k / n for k in range(1, n + 1)]
    stops = torch.tensor(np.array(stops), dtype=torch.float32)
    c = core.Core(scene.scenery([g], 1, len(stops) - 1, device="cpu"), res=8)  # a step per world
    c.agents.positions[:, 0] = stops[:-1]
    c.agents.velocity[:, 0] = (stops[1:] - stops[:-1]) * c.fps
    free = engine.physics(c.scenery, c.agents).progress
    touching = stops[:-1][free[:, 0] < 1]
    assert not len(touching), f"geometry {g.id}: touches a wall after {touching.tolist()}"


@pytest.mark.parametrize(
    "source, n",
    [
        pytest.param("maze", 2, marks=pytest.mark.slow),
        pytest.param("homes", 8, marks=pytest.mark.nightly),
        pytest.param("bench", 4, marks=pytest.mark.nightly),
    ],
)
def test_match_a_visibility_graph_in_many_homes(source, n):
    for g in sample(source, n, split="test"):
        check_against_oracle(g)


def test_match_a_visibility_graph_in_a_home():
    check_against_oracle(sample("homes", 2, split="test")[1])


@pytest.mark.parametrize("spare", [0.005, 0.012, 0.06])
def test_match_a_visibility_graph_through_narrow_passages(spare):
    """Two walls with gaps, at angles to the grid, and between them a corridor around a corner. All
    passages are `spare` metres wider than a body.
    """
    gap, tilt = WIDTH + spare, 0.37
    g = room(
        ((2, 0), (2 + tilt, 4 - gap)),
        ((4, 4), (4 - tilt, gap)),
        ((2.8, 1.2), (2.8, 2.4), (4.1, 2.4)),
        ((2.8 + gap, 1.2), (2.8 + gap, 2.4 - gap), (4.1, 2.4 - gap)),
        width=6,
    )
    result = geodesics_of(g, 100, 16)
    sides = {int(x > 3) + int(x > 5) for x in np.concatenate([result.spawns, result.goals])[:, 0]}
    assert sides == {0, 1, 2}, "everything is connected"
    check_against_oracle(g, n_starts=8, n_around=48)


# ---- By hand ----


def room(*walls, width=6.0, height=4.0, id=7):
    """A room with its lower-left corner at (1, 1), and walls in it, in its own coordinates: lists
    of the points that each connects.
    """
    corners = [(0, 0), (width, 0), (width, height), (0, height)]
    outer = list(zip(corners, [*corners[1:], corners[0]]))
    pieces = [piece for wall in walls for piece in itertools.pairwise(wall)]
    lines = np.array([*outer, *pieces], float) + 1
    masks = geometry.masks(lines, [np.array(corners, float) + 1])
    return dotdict(
        id=id, walls=lines.astype(np.float32), lights=np.ones((1, 2)), masks=masks, res=geometry.RES
    )


def test_path_in_an_empty_room_is_straight():
    result = geodesics_of(toys.box(5))
    straight = np.hypot(*np.moveaxis(result.spawns[:, None] - result.goals, -1, 0))
    np.testing.assert_allclose(result.lengths, straight, rtol=1e-5)
    assert (distances(result.goals.astype(float), toys.box(5).walls) > RADIUS + 0.05).all()


def test_more_goals_than_one_call_takes_are_refused():
    with pytest.raises(ValueError, match="17 goals per home: at most 16 in one call"):
        geodesics_of(toys.box(5), n_goals=17)


def test_fields_do_not_leak_through_walls():
    """A thin wall across the room, open at one end: distances on its two sides differ by metres,
    and a body that touches it reads those of its own side.
    """
    g = room(((1.03, 2.04), (6, 2.04)))
    result = geodesics_of(g, 60, 16)
    goals = result.goals - 1  # in the room's coordinates
    x = np.linspace(1.5, 5.5, 41)
    for side in (1, -1):
        points = np.stack([x, np.full(41, 2.04 + side * TOUCH)], 1)
        fields = read(result, points + 1)
        for goal in (side * (goals[:, 1] - 2.04) < 0).nonzero()[0]:  # on the other side
            around = points[:, 0] - 1.03 + np.hypot(*(goals[goal] - (1.03, 2.04)))
            assert (np.abs(fields[:, goal] - around) < 0.35).all(), "half a turn and its chords"


def test_fields_are_known_wherever_a_body_fits():
    g = sample("bench", 1)[0]
    result, random = geodesics_of(g), np.random.default_rng(1)
    height, width = result.fields.shape[1:]
    points = random.uniform((0, 0), (CELL * (width - 2), CELL * (height - 2)), (5_000, 2))
    points = points[distances(points + result.origin, g.walls.astype(float)) > TOUCH]
    fields = read(result, points + result.origin)
    known = np.isfinite(fields)
    assert (known.all(1) == known.any(1)).all()
    cells = np.rint(points / CELL).astype(int)
    reached = np.isfinite(result.fields[0])[cells[:, 1], cells[:, 0]]
    assert known[reached].all() and reached.mean() > 0.3


def test_a_homes_paths_do_not_depend_on_the_homes_beside_it():
    homes = toys.box(3), room(((3, 0), (3, 2)), width=5.0)
    generators = [np.random.Generator(np.random.Philox(1)) for _ in homes]
    together = geodesics(homes, 24, 4, RADIUS, generators)
    for g, result in zip(homes, together, strict=True):
        np.testing.assert_array_equal(result.fields, geodesics_of(g).fields)


@pytest.mark.cuda
def test_gpu_computes_the_same_bits():
    homes = [*sample("homes", 12), *sample("bench", 12), *sample("maze", 4), toys.box(5)]

    def all_of(device):
        generators = [np.random.Generator(np.random.Philox([1, d])) for d in range(len(homes))]
        return geodesics(homes, 128, 16, RADIUS, generators, device)

    for g, a, b in zip(homes, all_of("cpu"), all_of("cuda"), strict=True):
        for name, x, y in zip(a._fields, a, b):
            np.testing.assert_array_equal(x, y, err_msg=f"geometry {g.id}: {name}")


def test_cuda_kernels_on_a_cpu_compute_the_same_bits(cuda_on_cpu, monkeypatch):
    homes = [*sample("homes", 2), *sample("maze", 1), toys.box(5)]

    def all_of():
        generators = [np.random.Generator(np.random.Philox([1, d])) for d in range(len(homes))]
        return geodesics(homes, 24, 4, RADIUS, generators)

    expected = all_of()
    cuda_on_cpu.install(monkeypatch)
    for g, a, b in zip(homes, expected, all_of(), strict=True):
        for name, x, y in zip(a._fields, a, b):
            np.testing.assert_array_equal(x, y, err_msg=f"geometry {g.id}: {name}")
    names = {"clearances", "corner_distances", "corner_links", "path_lengths"}
    assert names <= cuda_on_cpu.launched
