"""Mazes: the tests read openings from walls and masks, independently of the generator.

In this file a cell is (column, row), with (0, 0) at the lower left.
"""

import hashlib
import itertools

import matplotlib
import numpy as np
import pytest

from megastep import contract, envs, geometry, modules
from megastep.engine.agents import AGENT_RADIUS
from megastep.geometries import mazes, sample
from megastep.geometries.homes.portable_generator import PortableGenerator
from megastep.modules.spawning import CLEARANCE, spawn_points

matplotlib.use("Agg")

# (size, corridor, thickness, braid): the default, extremes, and lengths that share no factor
KINDS = [
    (8, 1.0, 0.2, 0.0),
    (8, 1.0, 0.2, 1.0),
    (5, mazes.MIN_CORRIDOR, 0.02, 0.4),
    (2, 3.5, 0.1, 0.0),
    (7, 0.757, 0.333, 0.5),
    (4, 0.6, 1.5, 1.0),
    (16, 0.5, 0.1, 0.0),
]


@pytest.fixture(scope="module", params=KINDS, ids=str)
def kind(request):
    size, corridor, thickness, braid = request.param
    samples = [mazes.generate(seed, size, corridor, thickness, braid) for seed in range(6)]
    return size, corridor, thickness, braid, samples


# ---- Reading a maze ----


def cells(size):
    return list(itertools.product(range(size), repeat=2))


def place(g, cell, corridor, thickness):
    """The centre of a cell in metres, float64. The walls' smallest coordinates are cell (0, 0)'s
    corner.
    """
    corner = g.walls.min((0, 1)).astype(float)
    return corner + corridor / 2 + (corridor + thickness) * np.array(cell)


def crosses(walls, a, b):
    """True if the segment from a to b meets a wall. All are horizontal or vertical."""
    low, high = np.minimum(a, b) - 1e-4, np.maximum(a, b) + 1e-4
    return bool(((walls.min(1) < high) & (walls.max(1) > low)).all(1).any())


def graph(g, size, corridor, thickness):
    """{cell: the cells that it opens to}, by testing all pairs of neighbours against all walls."""
    opened = {cell: [] for cell in cells(size)}
    for x, y in cells(size):
        for other in ((x + 1, y), (x, y + 1)):
            if other in opened:
                ends = [place(g, cell, corridor, thickness) for cell in ((x, y), other)]
                if not crosses(g.walls, *ends):
                    opened[x, y].append(other)
                    opened[other].append((x, y))
    return opened


def steps(opened, start):
    """{cell: number of steps from the start}, for all reachable cells."""
    distances, queue = {start: 0}, [start]
    for cell in queue:
        for neighbour in opened[cell]:
            if neighbour not in distances:
                distances[neighbour] = distances[cell] + 1
                queue.append(neighbour)
    return distances


def n_openings(opened):
    return sum(map(len, opened.values())) // 2


# ---- Structure ----


def test_mazes_are_connected_and_perfect_ones_are_trees(kind):
    size, corridor, thickness, braid, samples = kind
    for g in samples:
        opened = graph(g, size, corridor, thickness)
        assert len(steps(opened, (0, 0))) == size * size
        if braid == 0:
            assert n_openings(opened) == size * size - 1
        if braid == 1:
            assert min(map(len, opened.values())) >= 2, "no dead end"


def test_masks_hold_one_connected_room(kind):
    size, corridor, thickness, _, samples = kind
    for g in samples:
        assert g.masks.dtype == np.int16 and set(np.unique(g.masks)) == {-1, 0, 1}
        labels, count = geometry.components(g.masks == 1)
        assert count == 1
        centres = [place(g, cell, corridor, thickness) for cell in cells(size)]
        at = geometry.indices(centres, g.masks.shape, g.res)
        assert (g.masks[tuple(at.T)] == 1).all(), "a cell's centre is not free"
        free = np.pad(g.masks == 1, 1)
        around = free[:-2, 1:-1] | free[2:, 1:-1] | free[1:-1, :-2] | free[1:-1, 2:]
        assert not (around & (g.masks == 0)).any(), "indoors touches outdoors"


def test_walls_form_closed_loops_of_maximal_segments(kind):
    """At every corner exactly one horizontal wall meets one vertical wall."""
    *_, samples = kind
    for g in samples:
        level = g.walls[:, 0, 1] == g.walls[:, 1, 1]
        assert (level != (g.walls[:, 0, 0] == g.walls[:, 1, 0])).all()
        ends = [sorted(map(tuple, g.walls[mask].reshape(-1, 2))) for mask in (level, ~level)]
        assert ends[0] == ends[1] and len(set(ends[0])) == len(ends[0])


def test_agents_fit(kind):
    *_, samples = kind
    assert mazes.MIN_CORRIDOR > 2 * (AGENT_RADIUS + CLEARANCE)
    for g in samples[:2]:
        points = spawn_points(g, 64, 1, AGENT_RADIUS, np.random.default_rng(1))
        assert len(np.unique(points, axis=0)) == 64, "some points were repeated"
        geometry.validate_geometry(g)


# ---- Randomness ----


def tree(seed, size, braid=0.0):
    opened = mazes.passages(size, braid, PortableGenerator(seed))
    return frozenset((a, b) for a, exits in enumerate(opened) for b in exits if a < b)


def test_braid_is_the_fraction_of_dead_ends_opened():
    for seed in range(40):
        perfect, n_opened = tree(seed, 8), []
        for braid in (0.0, 0.3, 0.7, 1.0):
            opened = tree(seed, 8, braid)
            assert perfect <= opened, "braiding closed an opening"
            n_opened.append(len(opened) - 63)
            degrees = np.bincount(np.array(list(opened)).ravel(), minlength=64)
            n_dead = (degrees == 1).sum()
            if braid == 0:
                n_dead_perfect = n_dead
            assert n_dead <= n_dead_perfect - int(braid * n_dead_perfect + 0.5)
        assert n_opened[0] == 0 < n_opened[1] < n_opened[3] <= n_dead_perfect


def test_bytes_of_mazes_are_unchanged():
    digest = hashlib.sha256()
    for size, corridor, thickness, braid in KINDS:
        for seed in range(10):
            g = mazes.generate(seed, size, corridor, thickness, braid)
            for values, dtype in (g.walls, "<f4"), (g.lights, "<f4"), (g.masks, "<i2"):
                digest.update(values.astype(dtype).tobytes())
            digest.update(np.array(g.res, "<f8").tobytes())
    assert digest.hexdigest() == "708117b2d5cd3a523deed4e3e027afb5cf81eb3b4655c8781f1e9647607f6d8d"


# ---- Lights ----


def test_every_cell_or_a_neighbour_is_lit(kind):
    size, corridor, thickness, _, samples = kind
    for g in samples[:1]:
        opened = graph(g, size, corridor, thickness)
        lit = {
            cell
            for cell in opened
            for light in g.lights
            if np.abs(light - place(g, cell, corridor, thickness)).min() < corridor / 4
            and not crosses(g.walls, light, place(g, cell, corridor, thickness))
        }
        assert all(cell in lit or lit & set(exits) for cell, exits in opened.items())


# ---- The source ----


def test_the_test_split_of_mazes_is_the_last_seeds():
    test = sample("maze", 501, "test", size=2)
    assert sorted(g.id for g in test[:500]) == list(range(4500, 5000))
    assert test[500] is test[0]
    training = [g.id for g in sample("maze", 500, "training", size=2)]
    assert max(training) < 4500 and len(set(training)) == 500


@pytest.mark.parametrize(
    "options, message",
    [
        (dict(size=1), "^size.* 1 .*at least 2"),
        (dict(braid=1.5), "^braid.* 1.5 .*at most 1"),
        (dict(thickness=0), "^thickness.* 0 "),
        (dict(corridor=0.3), "^corridor: 0.3 .*at least 0.32"),
        (dict(size=30, corridor=7.0), "size=30, corridor=7, .*too large.*200 m"),
        (dict(sise=3), "'sise'.*mean size"),
    ],
)
def test_mazes_of_wrong_size_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        sample("maze", 1, **options)


def test_explorer_runs_in_mazes():
    env = envs.Explorer(8, sample("maze", 4, size=3), device="cpu", patience=1, res=1, subsample=1)
    worlds = contract.rollout(env, 60)
    assert sum(int(world.truncated.sum()) for world in worlds)
    visible = modules.visible_texels(env.core.scenery, env.spawner.points)
    layouts = env.core.scenery.layouts
    n_texels = layouts.texel_starts[layouts.wall_starts.long()].diff()
    n_visible = sum((visible >> bit & 1).sum(1) for bit in range(32))
    assert (n_visible > 0.9 * n_texels).all()
