"""Geometries: cells and coordinates, masks of walls and rooms, validation."""

import matplotlib
import numpy as np
import pytest

from megastep import geometry, toys
from megastep.dotdict import dotdict

matplotlib.use("Agg")


def test_row_0_of_the_masks_is_at_the_top():
    centers = geometry.centers([[0, 0], [4, 0], [4, 2]], (5, 3), 0.2)
    assert np.allclose(centers, [[0.1, 0.9], [0.1, 0.1], [0.5, 0.1]])
    indices = geometry.indices([[0.1, 0.9], [0.19, 0.01], [0.41, 0.2]], (5, 3), 0.2)
    assert indices.tolist() == [[0, 0], [4, 0], [3, 2]]


def test_indices_and_centers_are_inverses():
    cells = np.stack(np.meshgrid(np.arange(40), np.arange(70), indexing="ij"), -1)
    assert (geometry.indices(geometry.centers(cells, (40, 70)), (40, 70)) == cells).all()


def test_masks_of_one_wall():
    masks = geometry.masks([[[0.3, 0.5], [0.7, 0.5]]], [], res=0.2)
    assert masks.dtype == np.int16
    assert masks.shape == (8, 9)  # (0.5, 0.7) m and a margin of 1 m
    expected = np.zeros((8, 9))
    expected[5, 1:4] = -1  # the third row from below is y = 0.4 to 0.6
    assert (masks == expected).all()


def test_a_wall_on_the_edge_of_a_cell_touches_both_sides():
    masks = geometry.masks([[[1.0, 0.5], [1.0, 0.9]]], [], res=0.2)[::-1]
    expected = [[i, j] for i in (2, 3, 4) for j in (4, 5)]
    assert np.argwhere(masks == -1).tolist() == expected


def touches(wall, low, high):
    """True if a segment touches the box low..high, by clipping it at each side in turn."""
    start, direction = wall[0], wall[1] - wall[0]
    first, last = 0.0, 1.0
    for axis in (0, 1):
        if abs(direction[axis]) < 1e-12:
            if not low[axis] <= start[axis] <= high[axis]:
                return False
        else:
            a, b = sorted((edge[axis] - start[axis]) / direction[axis] for edge in (low, high))
            first, last = max(first, a), min(last, b)
    return first <= last


def test_walls_mark_exactly_the_cells_that_they_touch():
    walls = np.random.default_rng(0).uniform(0.05, 4.5, (40, 2, 2))
    masks = geometry.masks(walls, [], res=0.25)[::-1]
    for (i, j), value in np.ndenumerate(masks):
        low = np.array([j, i]) * 0.25
        assert (value == -1) == any(touches(wall, low, low + 0.25) for wall in walls), (i, j)


def test_masks_do_not_depend_on_the_chunk_size(monkeypatch):
    walls = np.random.default_rng(0).uniform(0.05, 4.5, (40, 2, 2))
    expected = geometry.masks(walls, [])
    monkeypatch.setattr(geometry, "CHUNK", 7)
    assert (geometry.masks(walls, []) == expected).all()


def test_a_room_holds_the_cells_whose_centre_it_contains():
    triangle = np.array([[0.2, 0.2], [2.2, 0.2], [0.2, 2.2]])
    masks = geometry.masks(np.array([[[0.05, 2.9], [2.9, 2.9]]]), [triangle], res=0.2)
    x, y = np.moveaxis(geometry.centers(np.argwhere(np.ones_like(masks)), masks.shape), -1, 0)
    inside = (x > 0.2) & (y > 0.2) & (x + y < 2.4 - 1e-6)
    assert (masks.ravel() == 1).sum() == inside.sum() == 45  # 9 + 8 + ... + 1
    assert (masks.ravel()[inside] == 1).all()


def test_holes_are_outside_and_later_rooms_win():
    square, hole, other = (
        np.array([[a, a], [b, a], [b, b], [a, b]]) for a, b in ((0.2, 3.0), (1.0, 2.0), (2.6, 3.4))
    )
    masks = geometry.masks(np.array([[[0.05, 3.9], [3.9, 3.9]]]), [[square, hole], other])[::-1]
    diagonal = [int(masks[k, k]) for k in (2, 7, 11, 14, 15)]
    assert diagonal == [1, 0, 1, 2, 2]


def test_masks_refuses_walls_in_millimetres():
    with pytest.raises(ValueError, match="5000 m.*200 m.*unit"):
        geometry.masks([[[1.0, 1.0], [5000.0, 1.0]]], [])


def test_validate_geometry_converts_to_the_documented_types():
    box = toys.box()
    g = dotdict(box, masks=box.masks.astype(np.int64), walls=box.walls.tolist(), goal=3)
    valid = geometry.validate_geometry(g)
    assert valid.walls.dtype == valid.lights.dtype == np.float32 and valid.masks.dtype == np.int16
    assert isinstance(valid, dotdict) and valid.goal == 3
    assert isinstance(valid.res, float) and isinstance(valid.id, int)


def test_validate_geometry_drops_walls_of_length_0():
    g = toys.box()
    g["walls"] = np.concatenate([g.walls, [[[2.0, 2.0], [2.0, 2.0]]]])
    assert (geometry.validate_geometry(g).walls == toys.box().walls).all()


WRONG = {
    "has no 'lights'": lambda g: g.pop("lights"),
    "'walls' must hold numbers, .*<U1": lambda g: g.update(walls=np.full((3, 2, 2), "a")),
    "'walls' must hold numbers, .*complex64": lambda g: g.update(
        walls=g.walls.astype(np.complex64)
    ),
    r"'walls' .*shape \(n, 2, 2\), .*shape \(4, 4\)": lambda g: g.update(
        walls=g.walls.reshape(4, 4)
    ),
    r"'lights' .*shape \(n, 2\), .*shape \(2,\)": lambda g: g.update(lights=np.ones(2)),
    "'walls' holds a NaN": lambda g: g.update(walls=g.walls * np.array([1, np.nan])),
    "'lights' holds a NaN": lambda g: g.update(lights=g.lights * np.inf),
    "'walls' must be above 0, .* 0 m": lambda g: g.update(walls=g.walls - 1),
    "'walls' reaches up to 1e\\+30 m, .*200": lambda g: g.update(
        walls=g.walls / g.walls.min() * 1e30 / 6
    ),
    "'walls' reaches up to 1e\\+300 m, .*200": lambda g: g.update(walls=np.full((3, 2, 2), 1e300)),
    "'walls' must be above 0, .*-1e\\+300 m": lambda g: g.update(walls=np.full((3, 2, 2), -1e300)),
    "has no wall": lambda g: g.update(walls=np.ones((5, 2, 2))),
    "has 40,000 walls, .*32,768": lambda g: g.update(walls=np.ones((40_000, 2, 2))),
    "has no room": lambda g: g.update(masks=np.minimum(g.masks, 0)),
    "'masks' must hold integers, .*float32": lambda g: g.update(masks=g.masks.astype(np.float32)),
    "'masks' must be from -1 to 32,767, .*-2 to 1": lambda g: g.update(
        masks=np.where(g.masks < 0, -2, g.masks)
    ),
    "has masks of 4,002,000 cells, .*4,000,000": lambda g: g.update(
        masks=np.ones((2001, 2000), np.int8)
    ),
    "'res' .*from 0.01 to 10 .* 0$": lambda g: g.update(res=0.0),
    "'res' .* nan": lambda g: g.update(res=np.nan),
    "'id' must hold integers, .*float64": lambda g: g.update(id=1.5),
}


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("message", WRONG)
def test_validate_geometry_refuses_wrong_entries(message):
    g = toys.box()
    WRONG[message](g)
    with pytest.raises(ValueError, match=message):
        geometry.validate_geometry(g)


def test_display_draws_every_wall_and_light():
    g = toys.column()
    ax = geometry.display(g)
    lines, dots = ax.collections
    assert len(lines.get_segments()) == 8 and len(dots.get_offsets()) == 2
    image = ax.images[0]
    assert image.get_extent() == pytest.approx((0, 7, 0, 7))
    assert image.get_array().shape == (35, 35, 3)
    assert geometry.display(toys.box(), ax) is ax
    matplotlib.pyplot.close(ax.figure)
