"""PointGoal's goals: how they are drawn and observed, and the cache of shortest paths."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_geodesics import room

from megastep import core, engine, envs, geometry, modules, scene, toys
from megastep.coefficients import Coefficients
from megastep.envs.pointgoal import PROGRESS_ROWS
from megastep.envs.pointgoal import goals as module
from megastep.envs.pointgoal.goals import goal_fields, packed
from megastep.geodesics import Geodesics, geodesics
from megastep.geometries import sample
from tests.helpers.outputs import Poison

CELL = 0.1


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


# ---- Distance and bearing ----


def fields_of(random, n_layouts=3, n_goals=5, n_spawns=4, holes=0.2):
    """Random fields with holes, of a different size in each layout."""
    layouts = []
    for d in range(n_layouts):
        field = random.uniform(0, 20, (n_goals, 2 + 3 * d, 7 - 2 * d))
        field[random.random(field.shape) < holes] = np.inf
        points = random.uniform(1, 4, (n_goals, 2))
        origin = random.uniform(1, 2, 2).astype(np.float32)
        spawns = random.uniform(1, 4, (n_spawns, 2))
        lengths = random.uniform(1, 9, (n_spawns, n_goals))
        layouts.append(Geodesics(origin, field.astype(np.float16), spawns, points, lengths))
    return layouts


def goals_of(layouts, device="cpu"):
    """All of the layouts' goals, each of which may be drawn."""
    return packed(layouts, [np.ones(layout.lengths.shape, bool) for layout in layouts], device)


def boxes(device, n_envs, n_agents=1):
    return core.Core(
        scene.scenery([toys.box(w) for w in (3, 4, 5)], n_agents, n_envs, device=device), res=8
    )


def step(c, goals, goal_index, spawn_index=None, **settings):
    """A step in the middle of episodes with goals (N, A), or, with `spawn_index`, at their start.

    Returns (outputs, state).
    """
    n, on = goal_index.numel(), dict(device=c.device)
    is_start = spawn_index is not None
    spawn_index = spawn_index if is_start else torch.zeros_like(goal_index)
    env = SimpleNamespace(
        **dict(core=c, n_envs=c.n_envs, n_agents=c.n_agents, device=c.device, goals=goals),
        **dict(limit=500, seed=1, privileged_space=True) | settings,
        weights=Coefficients(c.device, bonus=5.0, cost=0.02, walk_cost=0.0),
        spawner=SimpleNamespace(point_index=spawn_index),
        _resets=engine.Resets(),
        goal_index=goal_index.flatten().clone(),
        progress=torch.zeros((PROGRESS_ROWS, n), **on),
        ages=torch.zeros(n, dtype=torch.int32, **on),
        ended=torch.full((n,), is_start, **on),
        n_draws=torch.zeros(n, dtype=torch.int32, **on),
    )
    return SimpleNamespace(**envs.PointGoal._judge(env, None)), env


def expected(point, field, origin, x, y, angle):
    """(straight, bearing, distance, descent) in double precision, from the definition."""
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))

    def own(vx, vy):
        return np.array([cosine * vx + sine * vy, cosine * vy - sine * vx])

    dx, dy = point[0] - x, point[1] - y
    straight = math.hypot(dx, dy)
    height, width = field.shape
    u, v = (x - origin[0]) / CELL, (y - origin[1]) / CELL
    column, row = min(max(int(u), 0), width - 2), min(max(int(v), 0), height - 2)
    right, up = min(max(u - column, 0), 1), min(max(v - row, 0), 1)
    cells = field[row : row + 2, column : column + 2].astype(float)
    known, weights = np.isfinite(cells), np.outer([1 - up, up], [1 - right, right])
    if not known.any():
        return straight, own(dx, dy) / straight, 0.0, np.zeros(2)  # as far as it was
    total = weights[known].sum()
    distance = (weights[known] @ cells[known]) / total if total > 1e-9 else cells[known].mean()
    cells = np.where(known, cells, distance)
    along_x = np.array([1 - up, up]) @ (cells[:, 1] - cells[:, 0]) / CELL
    along_y = np.array([1 - right, right]) @ (cells[1] - cells[0]) / CELL
    return straight, own(dx, dy) / straight, distance, -own(along_x, along_y)


@pytest.mark.parametrize("n_agents", [1, 3])
def test_goal_and_distance_match_the_definition(n_agents, device, monkeypatch):
    """With agents inside the fields, at their edges, outside and where all cells are infinite."""
    random, n = np.random.default_rng(1), 200
    arguments = fields_of(random, holes=0.5)
    c = boxes(device, n, n_agents)
    shape = n, n_agents
    c.agents.positions.copy_(torch.as_tensor(random.uniform(0.8, 2.8, (*shape, 2))))
    c.agents.angles.copy_(torch.as_tensor(random.uniform(-180, 180, shape)))
    goal_index = torch.as_tensor(random.integers(5, size=shape), dtype=torch.int32, device=device)
    goals = goals_of(arguments, device)
    poison = Poison(torch.empty)
    with monkeypatch.context() as patch:
        patch.setattr(torch, "empty", poison.allocate)
        out, state = step(c, goals, goal_index)
        outputs = "reward", "metrics", "goal_obs", "privileged"
        poison.check(**{name: getattr(out, name) for name in outputs})
    goal_obs, privileged = out.goal_obs.cpu().double(), out.privileged.cpu().double()
    n_unknown = 0
    for lane, (e, a) in enumerate(np.ndindex(shape)):
        d, g = int(c.scenery.layout[e]), int(goal_index[e, a])
        x, y = c.agents.positions[e, a].tolist()
        straight, way, distance, descent = expected(
            *(arguments[d].goals[g], arguments[d].fields[g], arguments[d].origin),
            x,
            y,
            float(c.agents.angles[e, a]),
        )
        assert goal_obs[lane, 0].tolist() == pytest.approx([straight / 10, *way], abs=2e-3)
        assert float(state.progress[2, lane]) == pytest.approx(distance, rel=1e-4)
        assert float(privileged[lane, 0, 0]) == pytest.approx(distance / 10, rel=1e-4)
        assert privileged[lane, 0, 1:3].tolist() == pytest.approx(descent.tolist(), abs=2e-2)
        n_unknown += distance == 0
    assert 0 < n_unknown < n


def test_goal_ahead_left_behind_and_right(device):
    """A goal two metres north of four agents that look east, north, west and south."""
    c = boxes(device, 4)
    c.agents.positions.fill_(1.5)
    c.agents.angles.copy_(torch.tensor([[0.0], [90.0], [180.0], [270.0]]))
    arguments = fields_of(np.random.default_rng(1), n_goals=1)
    field = 10 - np.arange(30, dtype=np.float16)[:, None] / 10 + np.zeros((1, 30, 30), np.float16)
    new = dict(goals=np.array([[1.5, 3.5]]), fields=field, origin=np.ones(2))
    goals = goals_of([layout._replace(**new) for layout in arguments], device)
    goal_index = torch.zeros((4, 1), dtype=torch.int32, device=device)
    out, state = step(c, goals, goal_index)
    turned = [[0, 1], [1, 0], [0, -1], [-1, 0]]
    assert out.goal_obs[:, 0].tolist() == [pytest.approx([0.2, *way], abs=1e-3) for way in turned]
    assert out.privileged[:, 0, 1:3].tolist() == [pytest.approx(way, abs=0.1) for way in turned]
    assert state.progress[2].tolist() == pytest.approx(4 * [9.5], abs=1e-2)
    c.agents.positions.copy_(torch.tensor([1.5, 3.5]))
    there, _ = step(c, goals, goal_index)
    assert there.goal_obs[:, 0].tolist() == 4 * [[0, 1, 0]] and there.terminal.all()


@pytest.mark.parametrize("number", [5, -1, 2**31 - 1])
@pytest.mark.parametrize("which", ["goal", "spawn point"])
def test_bad_indices_are_named_and_other_lanes_continue(which, number, device):
    c = boxes(device, 4)
    c.agents.positions.fill_(1.5)
    goals = goals_of(fields_of(np.random.default_rng(1)), device)
    zeros = torch.zeros((4, 1), dtype=torch.int32, device=device)
    wrong = zeros.clone()
    wrong[3] = number
    right = out = step(c, goals, zeros, None if which == "goal" else zeros)[0]
    with pytest.raises(engine.EngineError, match="environment 3 has a goal or a spawn point that"):
        out = step(c, goals, *((wrong, None) if which == "goal" else (zeros, wrong)))[0]
        engine.check(c.agents)
    for name in ("goal_obs", "privileged"):
        assert torch.equal(getattr(out, name)[:3], getattr(right, name)[:3])


# ---- Goals that are drawn ----


@pytest.mark.parametrize("n_agents", [1, 2])
def test_drawn_goals_are_in_range(n_agents, device):
    homes, n = [*sample("homes", 3), toys.column()], 300
    c = core.Core(scene.scenery(homes, n_agents, n, device=device), res=8)
    goals, spawns = goal_fields(homes, c, nearest=2.0, furthest=4.0)
    spawner = modules.RandomSpawns(homes, c, resample=True, points=spawns)
    truth = geodesics_of(homes, c.seed)
    drawn = set()
    spawner(c.agent_full(True))
    _, state = step(c, goals, torch.zeros_like(spawner.point_index), spawner.point_index)
    lengths = state.progress[4].cpu()
    assert 2 <= lengths.min() and lengths.max() <= 4 and (state.n_draws == 1).all()
    for lane, (e, a) in enumerate(np.ndindex(n, n_agents)):
        d, goal = int(c.scenery.layout[e]), int(state.goal_index[lane])
        place = c.agents.positions[e, a].cpu().numpy()
        spawn = (truth[d].spawns == place).all(1).nonzero()[0][0]
        assert float(lengths[lane]) == truth[d].lengths[spawn, goal]
        assert (goals.points[d, goal].cpu().numpy() == truth[d].goals[goal]).all()
        drawn.add((d, goal))
    assert len(drawn) > 40, "of 64"


@pytest.mark.parametrize(
    "range_, words",
    [
        ((40.0, 50.0), r"geometry \d+ has no goal from 40 to 50 m .* [\d.]+ m"),
        ((3.0, 3.0), "0 <= nearest < furthest"),
        ((-1.0, 3.0), "0 <= nearest < furthest"),
    ],
)
def test_no_goal_in_range(range_, words):
    c = core.Core(scene.scenery([toys.box(5)], 1, 2, device="cpu"), res=8)
    with pytest.raises(ValueError, match=words):
        goal_fields([toys.box(5)], c, *range_)


# ---- The cache ----


def geodesics_of(homes, seed=1):
    generators = [np.random.Generator(np.random.Philox([seed, d])) for d in range(len(homes))]
    return list(geodesics(homes, 128, 16, engine.AGENT_RADIUS, generators))


def all_of(geometries, seed=1):
    return module.all_geodesics(geometries, engine.AGENT_RADIUS, seed)


def test_geodesics_are_cached_without_loss(folder, monkeypatch):
    homes = sample("homes", 2)
    out = all_of(homes)
    monkeypatch.setattr(module.geodesics, "geodesics", lambda *parts: None)
    again = all_of(homes)
    assert len(list(folder.glob("geodesics-*"))) == 1
    for a, b, truth in zip(out, again, geodesics_of(homes), strict=True):
        for x, y, z in zip(a, b, truth, strict=True):
            assert x.dtype == z.dtype and (x == z).all() and (y == z).all()


def test_equal_geometries_share_geodesics(folder):
    box = toys.box(3)
    out = all_of([box, toys.column(), box])
    assert out[0] is out[2] and out[0] is not out[1]


def test_errors_name_the_geometry():
    boxes_ = [room(width=2 + 0.01 * i, height=1.5, id=i) for i in range(20)]
    boxes_[18]["masks"] = boxes_[18].masks * 0
    with pytest.raises(ValueError, match="geometry 18 has no room to spawn in"):
        all_of(boxes_)
    boxes_[18] = room(*[((x, 0), (x, 4)) for x in np.arange(0.2, 2, 0.2)], width=2, id=18)
    (i, j), masks = geometry.indices((2.0, 3.0), boxes_[18].masks.shape), boxes_[18].masks * 0
    masks[i, j] = 1
    boxes_[18]["masks"] = masks
    with pytest.raises(ValueError, match="geometry 18 has no point in a room"):
        all_of(boxes_)


# ---- Homes that are too large, or have no walls ----


def square_home(side, walls=True):
    """A home of `side` x `side` metres from (1, 1), with an inner wall."""
    a, b, middle = 1, 1 + side, 1 + side / 2
    outline = [(a, a), (b, a), (b, b), (a, b)]
    lines = [*zip(outline, outline[1:] + outline[:1]), ((middle, a), (middle, middle))]
    lines = np.array(lines, np.float32) if walls else np.zeros((0, 2, 2), np.float32)
    masks = geometry.masks(lines, [np.array(outline, float)] if walls else [])
    masks = masks if walls else np.ones((40, 40), np.int16)
    return toys.box() | dict(id=7, walls=lines, lights=np.array([[2.0, 2.0]]), masks=masks)


def test_fields_that_do_not_fit_are_refused_before_they_are_computed(monkeypatch):
    c = core.Core(scene.scenery(3 * [toys.box()], 1, 3, device="cpu"))
    monkeypatch.setattr(module, "all_geodesics", None)
    monkeypatch.setattr("megastep.devices.free_memory", lambda device: 10**5)
    with pytest.raises(engine.EngineError, match="3 layouts need .* at most 1 fit"):
        goal_fields(3 * [toys.box()], c)


def test_homes_without_walls(monkeypatch):
    home = square_home(6.0, walls=False)
    with pytest.raises(ValueError, match="^geometry 7 has no walls"):
        envs.PointGoal(2, [home], device="cpu")
    env = envs.Explorer(2, [home], device="cpu")
    env.reset()
    world = env.step(dict(actions=torch.full((2, 1), 3)))
    assert not world.reward.any() and not world.metrics.coverage.any()
