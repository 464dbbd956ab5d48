"""Goals that are drawn, where they lie from an agent, and what is kept of what was found."""

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_geodesics import room

from megastep import core, engine, modules, scene, toys, workers
from megastep.envs.pointgoal import geodesics as ways
from megastep.envs.pointgoal import goals as module
from megastep.envs.pointgoal.goal_fields import GoalFields
from megastep.envs.pointgoal.goals import goal_fields
from megastep.envs.pointgoal.step import PROGRESS_ROWS, pointgoal_step
from megastep.geometries import sample
from tests.helpers.outputs import Poison

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
CELL = 0.1


@pytest.fixture(params=DEVICES)
def device(request):
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    return request.param


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


# ---- GoalFields and where a goal lies ----


def fields_of(random, n_layouts=3, n_goals=5, n_spawns=4, holes=0.2):
    """Fields of random numbers, of other sizes in each layout, with holes; all goals allowed."""
    made = {key: [] for key in ("points", "fields", "origins", "spawns", "lengths", "allowed")}
    for d in range(n_layouts):
        height, width = 2 + 3 * d, 7 - 2 * d
        field = random.uniform(0, 20, (n_goals, height, width))
        field[random.random(field.shape) < holes] = np.inf
        made["fields"].append(field.astype(np.float16))
        made["points"].append(random.uniform(1, 4, (n_goals, 2)))
        made["origins"].append(random.uniform(1, 2, 2).astype(np.float32))
        made["spawns"].append(random.uniform(1, 4, (n_spawns, 2)))
        made["lengths"].append(random.uniform(1, 9, (n_spawns, n_goals)))
        made["allowed"].append(np.ones((n_spawns, n_goals), bool))
    return made


def boxes(device, n_envs, n_agents=1):
    return core.Core(
        scene.scenery([toys.box(w) for w in (3, 4, 5)], n_agents, n_envs, device=device), res=8
    )


def step(c, goals, goal_index, spawn_index=None, **settings):
    """What agents are told that are in the middle of an episode of their `chosen` goals (N, A)."""
    n, on = goal_index.numel(), dict(device=c.device)
    state = dict(
        goal_index=goal_index.flatten().clone(),
        progress=torch.zeros((PROGRESS_ROWS, n), **on),
        ages=torch.zeros(n, dtype=torch.int32, **on),
        ended=torch.full((n,), spawn_index is not None, **on),
        n_draws=torch.zeros(n, dtype=torch.int32, **on),
    )
    spawn_index = torch.zeros_like(goal_index) if spawn_index is None else spawn_index
    found = pointgoal_step(
        c.scenery, c.agents, goals, **state, spawn_index=spawn_index, privileged=True, **settings
    )
    return found, SimpleNamespace(**state)


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
def test_where_a_goal_lies_is_as_defined(n_agents, device, monkeypatch):
    """Agents within the fields, at their edges, beyond them and where nothing is known."""
    random, n = np.random.default_rng(1), 200
    made = fields_of(random, holes=0.5)
    c = boxes(device, n, n_agents)
    shape = n, n_agents
    c.agents.positions.copy_(torch.as_tensor(random.uniform(0.8, 2.8, (*shape, 2))))
    c.agents.angles.copy_(torch.as_tensor(random.uniform(-180, 180, shape)))
    chosen = torch.as_tensor(random.integers(5, size=shape), dtype=torch.int32, device=device)
    goals = GoalFields(**made, cell=CELL, device=device)
    poison = Poison(torch.empty)
    with monkeypatch.context() as patch:
        patch.setattr(torch, "empty", poison.allocate)
        found, state = step(c, goals, chosen)
        outputs = "reward", "metrics", "goal_obs", "privileged"
        poison.check(**{name: getattr(found, name) for name in outputs})
    bearing, told = found.goal_obs.cpu().double(), found.privileged.cpu().double()
    n_unknown = 0
    for lane, (e, a) in enumerate(np.ndindex(shape)):
        d, g = int(c.scenery.layout[e]), int(chosen[e, a])
        x, y = c.agents.positions[e, a].tolist()
        straight, way, distance, descent = expected(
            *(made[key][d][g] for key in ("points", "fields")),
            made["origins"][d],
            x,
            y,
            float(c.agents.angles[e, a]),
        )
        assert bearing[lane, 0].tolist() == pytest.approx([straight / 10, *way], abs=2e-3)
        assert float(state.progress[2, lane]) == pytest.approx(distance, rel=1e-4)
        assert float(told[lane, 0, 0]) == pytest.approx(distance / 10, rel=1e-4)
        assert told[lane, 0, 1:3].tolist() == pytest.approx(descent.tolist(), abs=2e-2)
        n_unknown += distance == 0
    assert 0 < n_unknown < n


def test_ahead_left_behind_and_right(device):
    """A goal two metres to the north of four agents that look east, north, west and south."""
    c = boxes(device, 4)
    c.agents.positions.fill_(1.5)
    c.agents.angles.copy_(torch.tensor([[0.0], [90.0], [180.0], [270.0]]))
    made = fields_of(np.random.default_rng(1), n_goals=1)
    field = 10 - np.arange(30, dtype=np.float16)[:, None] / 10 + np.zeros((1, 30, 30), np.float16)
    made |= dict(points=3 * [np.array([[1.5, 3.5]])], fields=3 * [field], origins=3 * [np.ones(2)])
    goals = GoalFields(**made, cell=CELL, device=device)
    chosen = torch.zeros((4, 1), dtype=torch.int32, device=device)
    found, state = step(c, goals, chosen)
    turned = [[0, 1], [1, 0], [0, -1], [-1, 0]]
    assert found.goal_obs[:, 0].tolist() == [pytest.approx([0.2, *way], abs=1e-3) for way in turned]
    assert found.privileged[:, 0, 1:3].tolist() == [pytest.approx(way, abs=0.1) for way in turned]
    assert state.progress[2].tolist() == pytest.approx(4 * [9.5], abs=1e-2)
    c.agents.positions.copy_(torch.tensor([1.5, 3.5]))
    there, _ = step(c, goals, chosen)
    assert there.goal_obs[:, 0].tolist() == 4 * [[0, 1, 0]] and there.terminal.all()


@pytest.mark.parametrize("number", [5, -1, 2**31 - 1])
@pytest.mark.parametrize("which", ["goal", "spawn point"])
def test_a_goal_or_spawn_point_that_is_none_is_named_and_others_go_on(which, number, device):
    c = boxes(device, 4)
    c.agents.positions.fill_(1.5)
    goals = GoalFields(**fields_of(np.random.default_rng(1)), cell=CELL, device=device)
    zeros = torch.zeros((4, 1), dtype=torch.int32, device=device)
    wrong = zeros.clone()
    wrong[3] = number
    right = found = step(c, goals, zeros, None if which == "goal" else zeros)[0]
    with pytest.raises(engine.EngineError, match="environment 3 has a goal or a spawn point that"):
        found = step(c, goals, *((wrong, None) if which == "goal" else (zeros, wrong)))[0]
        engine.check(c.agents)
    assert all(
        torch.equal(a[..., :3, :, :], b[..., :3, :, :]) for a, b in zip(found[5:], right[5:])
    )


def test_half_precision_is_read_as_pytorch_reads_it(device):
    """Every positive half, as the value of a field of one number; infinity leaves 0 as it was."""
    halves = torch.arange(0x7C01, dtype=torch.int32).to(torch.int16).view(torch.float16)
    c = core.Core(scene.scenery([toys.box(3)], 1, len(halves), device=device), res=8)
    c.agents.positions.fill_(1.05)
    made = fields_of(np.random.default_rng(1), 1, len(halves), 1)
    fields = np.repeat(halves.numpy()[:, None], 4, 1).reshape(-1, 2, 2)
    made |= dict(fields=[fields], origins=[np.ones(2)])
    chosen = torch.arange(len(halves), dtype=torch.int32, device=device)[:, None]
    goals = GoalFields(**made, cell=CELL, device=device)
    found = step(c, goals, chosen)[1].progress[2].cpu()
    torch.testing.assert_close(found[:-1], halves[:-1].float(), rtol=1e-6, atol=0)
    assert found[-1] == 0


@pytest.mark.parametrize(
    "key, wrong, words",
    [
        ("points", lambda made: made["points"][:2], r"points must be an array \(5, 2\) for each"),
        ("lengths", lambda made: 3 * [made["lengths"][0].T], "lengths must be an array"),
        ("fields", lambda made: 3 * [made["fields"][0].astype(float)], "but one is float64"),
        ("fields", lambda made: 3 * [made["fields"][0][:, :1]], "at least 2 x 2 cells"),
        ("allowed", lambda made: 3 * [made["allowed"][0] & False], "at least one goal for each"),
    ],
)
def test_fields_that_do_not_fit_are_refused(key, wrong, words):
    made = fields_of(np.random.default_rng(1))
    with pytest.raises(ValueError, match=words):
        GoalFields(**{**made, key: wrong(made)}, cell=CELL)


def test_goals_of_other_layouts_are_refused():
    goals = GoalFields(**fields_of(np.random.default_rng(1), 2), cell=CELL)
    with pytest.raises(ValueError, match="goals .* 3 layouts .* 2 on cpu"):
        step(boxes("cpu", 2), goals, torch.zeros((2, 1), dtype=torch.int32))


# ---- Goals that are drawn ----


@pytest.mark.parametrize("n_agents", [1, 2])
def test_goals_are_in_range_and_lengths_are_theirs(n_agents, device):
    homes, n = [*sample("homes", 3), toys.column()], 300
    c = core.Core(scene.scenery(homes, n_agents, n, device=device), res=8)
    goals = goal_fields(homes, c, nearest=2.0, furthest=4.0)
    spawner = modules.RandomSpawns(homes, c, resample=True, points=goals.spawns)
    truth = [
        ways.geodesics(
            g, 128, 16, c.agents.radius, np.random.Generator(np.random.Philox([c.seed, d]))
        )
        for d, g in enumerate(homes)
    ]
    drawn = set()
    spawner(c.agent_full(True))
    _, state = step(c, goals, torch.zeros_like(spawner.chosen), spawner.chosen)
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
def test_a_range_without_goals_is_refused(range_, words):
    c = core.Core(scene.scenery([toys.box(5)], 1, 2, device="cpu"), res=8)
    with pytest.raises(ValueError, match=words):
        goal_fields([toys.box(5)], c, *range_)


# ---- Found once, and kept ----


def all_of(geometries, seed=1):
    return module.all_geodesics(geometries, engine.AGENT_RADIUS, seed)


def test_ways_are_found_once_and_packing_loses_nothing(folder, monkeypatch):
    homes = sample("homes", 2)
    found, calls = all_of(homes), []
    monkeypatch.setattr(module, "geodesics", lambda *parts: calls.append(1))
    again = all_of(homes)
    assert not calls and len(list(folder.glob("geodesics-*"))) == 1
    for d, (a, b) in enumerate(zip(found, again)):
        random = np.random.Generator(np.random.Philox([1, d]))
        truth = ways.geodesics(homes[d], 128, 16, engine.AGENT_RADIUS, random)
        for x, y, z in zip(a, b, truth, strict=True):
            assert x.dtype == z.dtype and (x == z).all() and (y == z).all()
    monkeypatch.undo()


def test_geometries_that_are_one_object_share_what_was_found(folder):
    box = toys.box(3)
    found = all_of([box, toys.column(), box])
    assert found[0] is found[2] and found[0] is not found[1]


@pytest.mark.parametrize("fault", ["corrupt", "foreign"])
def test_a_cache_that_is_not_right_is_made_again_and_said(fault, folder):
    """Foreign: the file of another plan, intact, under this one's name."""
    right = all_of([toys.box(3)])
    (path,) = folder.glob("geodesics-*")
    if fault == "corrupt":
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    else:
        all_of([toys.column()])
        (other,) = set(folder.glob("geodesics-*")) - {path}
        path.write_bytes(other.read_bytes())
    with pytest.warns(UserWarning, match=f"{re.escape(str(path))} is damaged or .* made again"):
        again = all_of([toys.box(3)])
    assert all((a == b).all() for a, b in zip(right[0], again[0]))


def test_files_are_kept_up_to_a_gigabyte(folder, monkeypatch):
    one = all_of([toys.box(3)])
    size = next(folder.glob("geodesics-*")).stat().st_size
    assert one and module.MAX_BYTES == 10**9
    monkeypatch.setattr(module, "MAX_BYTES", 2.5 * size)
    for width in (3.1, 3.2, 3.3):
        all_of([toys.box(width)])
    assert len(list(folder.glob("geodesics-*"))) == 2


def test_many_are_found_by_several_processes_and_are_the_same(folder, monkeypatch, capfd):
    boxes_ = [room(width=2 + 0.01 * i, height=1.5, id=i) for i in range(workers.MIN_PARALLEL)]
    found = all_of(boxes_)
    assert "shortest ways in 48 layouts" in capfd.readouterr().err
    monkeypatch.setattr(workers, "MIN_PARALLEL", 1000)
    monkeypatch.setenv("MEGASTEP_CACHE", str(folder / "other"))
    alone = all_of(boxes_)
    assert all((x == y).all() for a, b in zip(found, alone) for x, y in zip(a, b))


def test_an_error_in_a_process_names_the_geometry(folder):
    boxes_ = [room(width=2 + 0.01 * i, height=1.5, id=i) for i in range(workers.MIN_PARALLEL)]
    boxes_[40]["masks"] = boxes_[40].masks * 0
    with pytest.raises(ValueError, match="geometry 40 has no room to spawn in"):
        all_of(boxes_)
