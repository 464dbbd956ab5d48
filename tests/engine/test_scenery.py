"""Scenery: views by environment, what is writable and what is read-only, shared layouts."""

import numpy as np
import pytest
import torch

from megastep import cache, core, engine, scene, toys
from megastep.dotdict import dotdict
from megastep.engine import operations
from megastep.engine.scenery import Layouts, Scenery
from megastep.ragged import Ragged
from tests.helpers import random_scenery

VIEWS = "lines", "lights", "textures", "baked"


@pytest.fixture
def shared():
    """Six environments of two agents that share two layouts."""
    return scene.scenery([toys.box(), toys.column()], n_agents=2, n_envs=6, device="cpu")


def image(scenery):
    """The view of an agent in the middle of each environment."""
    c = core.Core(scenery)
    c.agents.positions[:] = torch.tensor([2.0, 3.0])
    return engine.render(scenery, c.agents).screen.clone()


# ---- Views by environment ----


def expected(scenery):
    """All views, by loops over environments and lines."""
    layouts, out = scenery.layouts, {name: [] for name in VIEWS}
    for e, d in enumerate(scenery.layout.tolist()):
        out["lines"].append(torch.cat([scenery.agent_lines[e], layouts.lines[d]]))
        out["lights"].append(layouts.lights[d])
        widths = scenery.model_texels.diff().tolist()
        out["textures"] += layouts.agent_textures[d].split(widths)
        out["baked"] += scenery.agent_light[e].split(widths)
        for wall in range(*layouts.wall_starts[d : d + 2].tolist()):
            out["textures"].append(layouts.textures[wall])
            out["baked"].append(layouts.baked[wall])
    return out


def without_walls(n_agents):
    """Environments of two layouts: one has no walls, the other two walls."""
    other = random_scenery.random_environments(3, n_envs=2, n_agents=n_agents)
    walls = Layouts(
        Ragged(torch.tensor([[[1.0, 1], [2, 1]], [[2, 1], [2, 2]]]), [0, 2]),
        Ragged(torch.rand(5, 3), [2, 3]),
        Ragged(torch.zeros(0, 3), [0, 0]),
        torch.rand(2, 8 * n_agents, 3),
        "cpu",
    )
    widths = [1] * 8 * n_agents
    return Scenery(n_agents, walls, other.model, widths, [0, 1, 1])


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize(
    "make",
    [
        lambda: scene.scenery([toys.box(), toys.column()], 2, 6, device="cpu"),
        lambda: scene.scenery([toys.box()], 0, 3, device="cpu"),
        lambda: without_walls(1),
        lambda: without_walls(0),
    ],
    ids=["shared", "no agents", "no walls", "no agents nor walls"],
)
def test_views_join_agents_and_layouts(make, name):
    scenery = make()
    scenery.agent_light.copy_(torch.rand_like(scenery.agent_light))
    view, parts = getattr(scenery, name), expected(scenery)[name]
    assert isinstance(view, Ragged) and len(view) == len(parts)
    assert view.device == view.vals.device
    assert view.widths.tolist() == [len(part) for part in parts]
    assert torch.equal(view.vals, torch.cat(parts))
    assert all(torch.equal(piece, part) for piece, part in zip(view, parts, strict=True))
    assert view.starts.tolist() == np.cumsum([0, *map(len, parts)])[:-1].tolist()
    assert view.ends.tolist() == np.cumsum([0, *map(len, parts)])[1:].tolist()
    assert view.inverse.tolist() == [i for i, part in enumerate(parts) for _ in part]
    assert torch.equal(view[-1], parts[-1]) and torch.equal(view[1:3].vals, torch.cat(parts[1:3]))
    assert [piece.tolist() for piece in view[::-2]] == [part.tolist() for part in parts[::-2]]


@pytest.mark.parametrize("index", [6, -7])
def test_environment_out_of_range(shared, index):
    with pytest.raises(IndexError, match=f"index {index} is out of range"):
        shared.lines[index]
    with pytest.raises(ValueError, match=f"e must be an integer from -6 to 5, but {index}"):
        shared.env(index)


# ---- Writing ----


def statements():
    """Ways to write into a view."""

    def add(tensor):
        tensor += 1

    return {
        "vals[:]": lambda view: view.vals.__setitem__(slice(None), 1),
        "vals.mul_": lambda view: view.vals.mul_(2),
        "vals +=": lambda view: add(view.vals),
        "out=": lambda view: torch.add(view.vals, 1, out=view.vals),
        "[0][:]": lambda view: view[0].__setitem__(slice(None), 0),
        "[1:3].vals": lambda view: view[1:3].vals.zero_(),
        "widths": lambda view: view.widths.zero_(),
    }


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("statement", statements())
def test_writing_into_a_view_raises(shared, name, statement):
    with pytest.raises(ValueError, match=rf"scenery.{name} is a read-only|read-only"):
        statements()[statement](getattr(shared, name))


def test_writes_to_a_layout_reach_all_its_environments(shared):
    before = image(shared)
    shared.layouts.textures.vals[: int(shared.layouts.texel_starts[4])] = 0  # the box's four walls
    after = image(shared)
    assert (after[0::2] != before[0::2]).flatten(1).any(1).all(), "the boxes are black now"
    assert torch.equal(after[1::2], before[1::2]), "the columns are as they were"
    assert torch.equal(after[0], after[2])


def test_bake_after_moving_lights_and_walls(shared):
    before = image(shared)
    shared.layouts.lights.vals[:, 2] *= 0.25
    assert torch.equal(image(shared)[:, :, :, 0].isnan(), before[:, :, :, 0].isnan())
    engine.bake(shared)
    darker = image(shared)
    assert darker.sum() < before.sum()
    shared.layouts.lines.vals[:4] += 0.5
    engine.bake(shared)
    assert (image(shared) != darker).any()


def test_bounding_boxes_are_updated_in_place(shared):
    layouts, address = shared.layouts, shared.layouts.boxes.data_ptr()
    before = layouts.boxes.clone()
    assert before.tolist()[0] == [1, 1, 6, 6]
    layouts.lines.vals += 1
    engine.bake(shared)
    assert layouts.boxes.data_ptr() == address, "a captured graph reads the old address"
    assert torch.equal(layouts.boxes, before + 1)


def test_boxes_hold_32_walls_of_one_layout():
    other = random_scenery.random_environments(1, n_envs=3, n_walls=70)
    layouts = other.scenery().layouts
    starts = layouts.box_starts.tolist()
    for d in range(3):
        groups = layouts.lines[d].split(32)
        assert len(groups) == starts[d + 1] - starts[d] == 3
        for box, walls in zip(layouts.boxes[starts[d] :], groups):
            assert box.tolist() == [*walls.amin((0, 1)).tolist(), *walls.amax((0, 1)).tolist()]


def attributes(thing):
    return [name for name in vars(thing) if not name.startswith("_")]


def test_attributes_cannot_be_replaced(shared):
    for thing in (shared, shared.layouts, shared.layouts.lines):
        for name in attributes(thing):
            with pytest.raises(AttributeError, match=name):
                setattr(thing, name, None)
            with pytest.raises(AttributeError, match=name):
                delattr(thing, name)
    assert {"layout", "agent_lines", "agent_light", "model", "layouts", "n_agents"} <= set(
        attributes(shared)
    )


def test_environments_change_layout_in_place(shared):
    before = image(shared)
    shared.layout[:] = shared.layout.flip(0)
    after = image(shared)
    assert shared.layout.tolist() == [1, 0] * 3 and torch.equal(after, before.flip(0))


def test_env_returns_copies(shared):
    before = [view.clone() for view in (shared.layouts.lines.vals, shared.layouts.lights.vals)]
    lines, colours, lights = shared.env(1)
    for tensor in (lines, lights, *colours):
        tensor.zero_()
    after = [shared.layouts.lines.vals, shared.layouts.lights.vals]
    assert all(map(torch.equal, before, after))
    assert torch.equal(shared.env(-1)[0], shared.env(5)[0])


# ---- Which environment starts with which layout ----


@pytest.mark.parametrize(
    "n_geometries, n_envs, layouts",
    [
        (3, 7, [0, 1, 2, 0, 1, 2, 0]),
        (10, 4, [0, 2, 5, 7]),
        (50, 3, [0, 16, 33]),
        (4, 4, [0, 1, 2, 3]),
    ],
)
def test_environments_are_spread_over_all_geometries(n_geometries, n_envs, layouts):
    geometries = n_geometries * [toys.box()]
    made = scene.scenery(geometries, n_envs=n_envs, device="cpu")
    assert made.layout.tolist() == layouts
    assert scene.spread(range(n_geometries), n_envs) == sorted(set(layouts))


def test_light_from_the_cache_has_the_same_bits(tmp_path, monkeypatch):
    baked = scene.scenery([toys.box(), toys.column()], device="cpu").layouts.texels
    monkeypatch.setattr(cache, "_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(operations, "MIN_CACHED", 1)
    for bake in (operations.bake, None):  # the second time nothing is computed
        monkeypatch.setattr(operations, "bake", bake)
        scenery = scene.scenery([toys.box(), toys.column()], device="cpu")
        assert scenery.layouts.texels.equal(baked) and not baked[:, 3].eq(1).all()


@pytest.mark.parametrize("name", ("walls", "lights"))
def test_a_geometry_of_lists_is_refused(name):
    box = toys.box()
    lists = dotdict(box, **{name: box[name].tolist()})
    with pytest.raises(ValueError, match=rf"geometries\[1\].{name} must be a numpy array of num"):
        scene.scenery([box, lists], device="cpu")
