"""Mazes of rooms and corridors. The tests read floor from walls, independently of the generator."""

import hashlib

import numpy as np
import pytest

from megastep import geometry
from megastep.geometries import memory_mazes, sample

KINDS = memory_mazes.KINDS
CELL = 0.9


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param, [memory_mazes.generate(seed, request.param, CELL) for seed in range(12)]


def floor_of(g, size):
    """Returns which cells are floor, (size, size) bool, row 0 at the bottom: those that lie to the
    right of an odd number of upright walls.
    """
    centres = 1 + CELL * (np.arange(size) + 1.5)
    upright = g.walls[g.walls[:, 0, 0] == g.walls[:, 1, 0]]
    x, low, high = upright[:, 0, 0], upright[..., 1].min(1), upright[..., 1].max(1)
    crossed = (low < centres[:, None]) & (centres[:, None] < high)  # (row, wall)
    left = x < centres[:, None]
    return (crossed[:, None] & left).sum(-1) % 2 == 1


def beside(floor):
    padded = np.pad(floor, 1).astype(int)
    return padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]


def test_walls_are_closed_and_every_floor_can_be_reached(kind):
    size, samples = kind
    for g in samples:
        ends, counts = np.unique(g.walls.reshape(-1, 2).round(4), axis=0, return_counts=True)
        assert (counts % 2 == 0).all(), "a wall ends where no other begins"
        assert geometry.components(floor_of(g, size))[1] == 1


def test_no_dead_end_is_left(kind):
    size, samples = kind
    for g in samples:
        floor = floor_of(g, size)
        assert (beside(floor)[floor] >= 2).all()


def test_rooms_are_as_many_and_as_large_as_the_size_has(kind):
    """Each is a rectangle of 3 or more cells, apart from the others."""
    size, samples = kind
    wanted = KINDS[size]
    for g in samples:
        n_rooms = g.masks.max()
        assert wanted.objects <= n_rooms <= wanted.rooms
        for number in range(1, n_rooms + 1):
            rows, columns = (g.masks == number).nonzero()
            sides = [(np.ptp(at) * g.res + 0.5) / CELL for at in (rows, columns)]
            assert all(3 <= round(side) <= wanted.widest for side in sides)
            assert geometry.components(g.masks == number)[1] == 1


def test_there_are_loops_and_corridors():
    """In most mazes. A loop is an edge between cells beyond those of a tree, once rooms count as
    one cell each.
    """
    n_loops, n_corridors = [], []
    for seed in range(40):
        floor, rooms = memory_mazes.floor_plan(seed, 9)
        edges = (floor[1:] & floor[:-1]).sum() + (floor[:, 1:] & floor[:, :-1]).sum()
        squares = (floor[1:, 1:] & floor[:-1, 1:] & floor[1:, :-1] & floor[:-1, :-1]).sum()
        n_loops.append(edges - floor.sum() + 1 - squares)
        n_corridors.append(floor.sum() - sum(height * width for *_, height, width in rooms))
    assert np.mean(np.array(n_loops) > 0) > 0.5 and np.median(n_corridors) >= 6


def test_a_seed_gives_the_same_maze_on_every_machine():
    digest = hashlib.sha256()
    for size in KINDS:
        g = memory_mazes.generate(7, size)
        digest.update(g.walls.tobytes() + g.lights.tobytes() + g.masks.tobytes())
    assert digest.hexdigest()[:16] == "84073e7a4b7e0f09"
    plans = {memory_mazes.floor_plan(seed, 9)[0].tobytes() for seed in range(100)}
    assert len(plans) == 100


def test_every_cell_has_light(kind):
    _, samples = kind
    for g in samples:
        geometry.validate_geometry(g)
        at = geometry.indices(g.lights, g.masks.shape, g.res)
        assert (g.masks[tuple(at.T)] >= 0).all(), "a light in a wall"


def test_the_source_splits_its_mazes():
    training, test = (
        {g.id for g in sample("memory_maze", 30, split)} for split in ("training", "test")
    )
    assert len(training) == len(test) == 30 and max(training) < 4500 <= min(test)


@pytest.mark.parametrize(
    "options, words",
    [(dict(size=10), "size=10: Memory Maze has mazes of 9, 11, 13, 15"), (dict(cell=0.2), "cell")],
)
def test_bad_options_are_named(options, words):
    with pytest.raises(ValueError, match=words):
        sample("memory_maze", 1, **options)
