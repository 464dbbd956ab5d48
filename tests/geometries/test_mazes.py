"""Mazes: what is open and what is shut is read from their walls and masks, not from the generator.

A cell is (column, row) here, (0, 0) at the lower left.
"""

import hashlib
import itertools
import re
import time

import matplotlib
import numpy as np
import pytest

from megastep import contract, envs, geometry, modules
from megastep.agents.cli import record
from megastep.engine import devices
from megastep.engine.agents import AGENT_RADIUS
from megastep.geometries import homes, mazes, sample
from megastep.geometries.homes.portable_generator import PortableGenerator
from megastep.modules.spawning import CLEARANCE, spawn_points
from scripts import check_homes, show_mazes

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
    made = [mazes.generate(seed, size, corridor, thickness, braid) for seed in range(6)]
    return size, corridor, thickness, braid, made


# ---- An independent reading ----


def cells(size):
    return list(itertools.product(range(size), repeat=2))


def place(g, cell, corridor, thickness):
    """The centre of a cell in metres, float64; the least coordinate of the walls is the first
    cell's.
    """
    corner = g.walls.min((0, 1)).astype(float)
    return corner + corridor / 2 + (corridor + thickness) * np.array(cell)


def crosses(walls, a, b):
    """Whether the level or upright segment from a to b meets one of the walls, which are so too."""
    low, high = np.minimum(a, b) - 1e-4, np.maximum(a, b) + 1e-4
    return bool(((walls.min(1) < high) & (walls.max(1) > low)).all(1).any())


def graph(g, size, corridor, thickness):
    """{cell: the cells that it opens to}, by trying every pair of neighbours against every wall."""
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
    """{cell: how many steps it is away}, of the cells that can be reached."""
    found, queue = {start: 0}, [start]
    for cell in queue:
        for other in opened[cell]:
            if other not in found:
                found[other] = found[cell] + 1
                queue.append(other)
    return found


def n_openings(opened):
    return sum(map(len, opened.values())) // 2


# ---- What a maze is ----


def test_every_cell_can_be_reached_and_perfect_mazes_are_trees(kind):
    size, corridor, thickness, braid, made = kind
    for g in made:
        opened = graph(g, size, corridor, thickness)
        assert len(steps(opened, (0, 0))) == size * size
        if braid == 0:
            assert n_openings(opened) == size * size - 1
        if braid == 1:
            assert min(map(len, opened.values())) >= 2, "no dead end"


def test_the_masks_hold_one_room_that_joins_all_cells(kind):
    size, corridor, thickness, _, made = kind
    for g in made:
        assert g.masks.dtype == np.int16 and set(np.unique(g.masks)) == {-1, 0, 1}
        labels, count = check_homes.components(g.masks == 1)
        assert count == 1
        centres = [place(g, cell, corridor, thickness) for cell in cells(size)]
        at = geometry.indices(centres, g.masks.shape, g.res)
        assert (g.masks[tuple(at.T)] == 1).all(), "the middle of each cell is free"
        free = np.pad(g.masks == 1, 1)
        around = free[:-2, 1:-1] | free[2:, 1:-1] | free[1:-1, :-2] | free[1:-1, 2:]
        assert not (around & (g.masks == 0)).any(), "walls lie between indoors and all else"


def test_masks_are_those_of_the_rooms_and_walls(kind):
    """Rooms told as rectangles, one per cell and opening, to the function that every other
    geometry is rasterised by."""
    size, corridor, thickness, _, made = kind
    for g in made[:3]:
        rings = []
        for a, others in graph(g, size, corridor, thickness).items():
            for b in [a, *(other for other in others if other > a)]:
                ends = np.array([place(g, cell, corridor, thickness) for cell in (a, b)])
                (x0, y0), (x1, y1) = ends.min(0) - corridor / 2, ends.max(0) + corridor / 2
                if b[0] > a[0]:
                    x0, x1 = x0 + corridor, x1 - corridor
                elif b[1] > a[1]:
                    y0, y1 = y0 + corridor, y1 - corridor
                rings.append([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        assert np.array_equal(g.masks, geometry.masks(g.walls, [rings], g.res))


def test_walls_close_and_are_as_long_as_they_are_straight(kind):
    """At every corner one level wall meets one upright wall: none ends freely, and none of two
    could be one."""
    *_, made = kind
    for g in made:
        level = g.walls[:, 0, 1] == g.walls[:, 1, 1]
        assert (level != (g.walls[:, 0, 0] == g.walls[:, 1, 0])).all()
        ends = [sorted(map(tuple, g.walls[which].reshape(-1, 2))) for which in (level, ~level)]
        assert ends[0] == ends[1] and len(set(ends[0])) == len(ends[0])


def test_walls_have_two_faces(kind):
    """Each cell has four sides, and an opening takes one of two cells and adds its two jambs."""
    size, corridor, thickness, _, made = kind
    for g in made:
        n = n_openings(graph(g, size, corridor, thickness))
        length = np.abs(g.walls[:, 1] - g.walls[:, 0]).astype(float).sum()
        told = 4 * size * size * corridor - 2 * n * corridor + 2 * n * thickness
        assert length == pytest.approx(told, rel=1e-5)  # float32 of coordinates


def test_agents_fit(kind):
    size, corridor, thickness, _, made = kind
    assert mazes.MIN_CORRIDOR > 2 * (AGENT_RADIUS + CLEARANCE)
    for g in made[:2]:
        points = spawn_points(g, 64, 1, AGENT_RADIUS, np.random.default_rng(1))
        assert len(np.unique(points, axis=0)) == 64, "there is room for so many"
        geometry.checked(g)


# ---- What chance decides ----


def tree(seed, size, braid=0.0):
    opened = mazes.passages(size, braid, PortableGenerator(seed))
    return frozenset((a, b) for a, others in enumerate(opened) for b in others if a < b)


def test_every_perfect_maze_is_equally_likely():
    """A 3 x 3 grid has 192 spanning trees (Kirchhoff). Chi-square of 9,600 draws has mean 191 and
    standard deviation 19.5; a depth-first search gives over 10,000."""
    trees, numbers = {}, []
    for seed in range(9_600):
        numbers.append(trees.setdefault(tree(seed, 3), len(trees)))
    counts = np.bincount(numbers)
    assert len(counts) == 192
    assert ((counts - 50) ** 2 / 50).sum() < 191 + 4 * 19.5


def test_dead_ends_are_opened_as_told():
    for seed in range(40):
        perfect, n_opened = tree(seed, 8), []
        for braid in (0.0, 0.3, 0.7, 1.0):
            opened = tree(seed, 8, braid)
            assert perfect <= opened, "the maze is the perfect one with more openings"
            n_opened.append(len(opened) - 63)
            degrees = np.bincount(np.array(list(opened)).ravel(), minlength=64)
            n_dead = (degrees == 1).sum()
            if braid == 0:
                most = n_dead
            assert n_dead <= most - int(braid * most + 0.5)
        assert n_opened[0] == 0 < n_opened[1] < n_opened[3] <= most


def test_a_maze_depends_on_its_arguments_alone():
    alone = mazes.generate(7, braid=0.5)
    mazes.generate(3)
    again = mazes.generate(7, braid=0.5)
    assert all(np.array_equal(alone[key], again[key]) for key in alone)
    assert not np.array_equal(alone.walls, mazes.generate(8, braid=0.5).walls)


def test_mazes_are_the_same_bytes_on_any_machine():
    digest = hashlib.sha256()
    for size, corridor, thickness, braid in KINDS:
        for seed in range(10):
            g = mazes.generate(seed, size, corridor, thickness, braid)
            for values, dtype in (g.walls, "<f4"), (g.lights, "<f4"), (g.masks, "<i2"):
                digest.update(values.astype(dtype).tobytes())
            digest.update(np.array(g.res, "<f8").tobytes())
    assert digest.hexdigest() == "708117b2d5cd3a523deed4e3e027afb5cf81eb3b4655c8781f1e9647607f6d8d"


# ---- Lights ----


def test_a_light_reaches_every_cell_or_one_beside_it(kind):
    size, corridor, thickness, _, made = kind
    for g in made[:3]:
        opened = graph(g, size, corridor, thickness)
        lit = {
            cell
            for cell in opened
            for light in g.lights
            if np.abs(light - place(g, cell, corridor, thickness)).min() < corridor / 4
            and not crosses(g.walls, light, place(g, cell, corridor, thickness))
        }
        assert all(cell in lit or lit & set(others) for cell, others in opened.items())


@pytest.mark.parametrize("reach", [0, 1, 2])
def test_perfect_mazes_have_as_few_lights_as_can_be(reach):
    for seed in range(12):
        opened = mazes.passages(3, 0.0, PortableGenerator(seed))
        near = [{b for b, n in steps(opened, a).items() if n <= reach} for a in range(9)]
        found = mazes.lit_cells(opened, reach)
        assert set().union(*(near[cell] for cell in found)) == set(range(9))
        fewer = itertools.combinations(range(9), len(found) - 1)
        assert not any(len(set().union(*(near[c] for c in chosen))) == 9 for chosen in fewer)


@pytest.mark.parametrize("reach", [0, 1, 2])
def test_loops_are_lit_as_well(reach):
    for seed in range(20):
        opened = mazes.passages(9, 1.0, PortableGenerator(seed))
        found = mazes.lit_cells(opened, reach)
        assert set().union(
            *({b for b, n in steps(opened, a).items() if n <= reach} for a in found)
        ) == set(range(81))


def test_lights_are_as_dense_as_in_homes():
    made = [homes.generate(seed) for seed in range(30)]
    home = sum(sum(g.areas) for g in made) / sum(len(g.lights) for g in made)
    drawn = [mazes.generate(seed) for seed in range(60)]
    maze = 60 * (8 * 1.2) ** 2 / sum(len(g.lights) for g in drawn)
    assert 0.7 < maze / home < 1.4, "square metres per light"


# ---- The source ----


def test_mazes_for_testing_are_the_last_seeds():
    test = sample("maze", 501, "test", size=2)
    assert sorted(g.id for g in test[:500]) == list(range(4500, 5000))
    assert test[500] is test[0]
    training = [g.id for g in sample("maze", 500, "training", size=2)]
    assert max(training) < 4500 and len(set(training)) == 500


def test_options_reach_the_generator():
    options = dict(size=3, corridor=0.8, thickness=0.3, braid=1.0)
    (g,) = sample("maze", 1, seed=5, **options)
    made = mazes.generate(g.id, *options.values())
    assert all(np.array_equal(g[key], made[key]) for key in made)


@pytest.mark.parametrize(
    "options, message",
    [
        (dict(size=1), "^size: 1 is out of range: allowed is from 2 to 32$"),
        (dict(braid=1.5), "^braid: 1.5 is out of range: allowed is from 0 to 1$"),
        (dict(thickness=0), "^thickness: 0 is out of range"),
        (dict(corridor=0.3), "^corridor=0.3 m is too narrow for an agent: take 0.32 or more$"),
        (dict(size=30, corridor=7.0), "^a maze of 30 x 30 cells, 7 m wide .* is too large: it rea"),
        (dict(sise=3), "called 'sise'; did you mean 'size'"),
    ],
)
def test_mazes_of_impossible_size_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        sample("maze", 1, **options)


@pytest.mark.parametrize(
    "overrides, message",
    [
        (["geometry.corridor=0.3"], "corridor=0.3 m is too narrow for an agent"),
        (["geometry.n=4000", "geometry.size=32"], "mazes of 32 x 32 cells need .* at most .* fit"),
        (["geometry.size=32", "geometry.corridor=8"], "is too large: it reaches 264.4 m"),
    ],
)
def test_bad_mazes_are_one_sentence_and_exit_code_2(overrides, message, monkeypatch, capsys):
    monkeypatch.setattr(devices, "free_memory", lambda device: 1e9)
    assert record.main(["env=minimal", "geometry=maze", "device=cpu", *overrides]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search(message, line)


def test_the_memory_that_is_asked_for_covers_walls_and_masks():
    for size, corridor, thickness, braid in KINDS:
        g = mazes.generate(1, size, corridor, thickness, braid)
        length = np.abs(g.walls[:, 1] - g.walls[:, 0]).sum()
        told = mazes.bytes_each(size, corridor, thickness)
        assert told >= mazes.BYTES_PER_METRE * length * 0.999 + g.masks.nbytes
        assert told < 2 * (mazes.BYTES_PER_METRE * length + g.masks.nbytes)


def test_explorer_lives_in_mazes():
    env = envs.Explorer(8, sample("maze", 4, size=3), device="cpu", patience=1, res=1, subsample=1)
    worlds = contract.rollout(env, 60)
    assert sum(int(world.truncated.sum()) for world in worlds)
    visible = modules.visible_texels(env.core.scenery, env.spawner.points)
    n_texels = env.core.scenery.layouts.texel_starts[
        env.core.scenery.layouts.wall_starts.long()
    ].diff()
    bits = sum((visible >> bit & 1).sum(1) for bit in range(32))
    assert (bits > 0.9 * n_texels).all(), "of faces, nearly all can be seen"


@pytest.mark.slow
def test_two_thousand_mazes_are_quickly_made():
    start = time.process_time()
    sample("maze", 2_000)
    assert time.process_time() - start < 8  # seconds; 2 on one core of an EPYC


def test_the_sheet_shows_every_maze():
    figure = show_mazes.sheet(size=3)
    titles = [ax.get_title() for ax in figure.axes]
    assert len(titles) == 12 and titles[0].startswith("maze 0, braid 0: ")
    assert all(": 0 dead ends" in title for title in titles[8:])
    matplotlib.pyplot.close(figure)
