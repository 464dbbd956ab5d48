"""Goals that are drawn, where they lie from an agent, and what is kept of what was found."""

import math
import re

import numpy as np
import pytest
import torch
from outputs import Poison
from test_geodesics import room

from megastep import core, engine, modules, scene, toys, workers
from megastep.geometries import sample
from megastep.modules import geodesics as ways
from megastep.modules import goals as module

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


# ---- engine.to_goal ----


def fields_of(random, n_layouts=3, n_goals=5, holes=0.2):
    """Fields of random numbers, of other sizes in each layout, with holes."""
    points, fields, origins = [], [], []
    for d in range(n_layouts):
        height, width = 2 + 3 * d, 7 - 2 * d
        field = random.uniform(0, 20, (n_goals, height, width))
        field[random.random(field.shape) < holes] = np.inf
        fields.append(field.astype(np.float16))
        points.append(random.uniform(1, 4, (n_goals, 2)))
        origins.append(random.uniform(1, 2, 2).astype(np.float32))
    return points, fields, origins


def boxes(device, n_envs, n_agents=1):
    return core.Core(
        scene.scenery([toys.box(w) for w in (3, 4, 5)], n_agents, n_envs, device=device), res=8
    )


def expected(point, field, origin, x, y, angle):
    """bearing, straight, distance, descent in double precision, from the definition."""
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
        return straight, own(dx, dy) / straight, math.inf, np.zeros(2)
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
    points, fields, origins = fields_of(random)
    c = boxes(device, n, n_agents)
    shape = n, n_agents
    c.agents.positions.copy_(torch.as_tensor(random.uniform(0.8, 2.8, (*shape, 2))))
    c.agents.angles.copy_(torch.as_tensor(random.uniform(-180, 180, shape)))
    goals = torch.as_tensor(random.integers(5, size=shape), dtype=torch.int32, device=device)
    made = engine.DistanceFields(points, fields, origins, CELL, device)
    poison = Poison(torch.empty)
    with monkeypatch.context() as patch:
        patch.setattr(torch, "empty", poison.allocate)
        found = engine.to_goal(c.scenery, c.agents, made, goals)
        poison.check(**found._asdict())
    found = engine.ToGoal(*(value.cpu().double() for value in found))
    n_infinite = 0
    for e, a in np.ndindex(shape):
        d, g = int(c.scenery.layout[e]), int(goals[e, a])
        x, y = c.agents.positions[e, a].tolist()
        straight, bearing, distance, descent = expected(
            points[d][g], fields[d][g], origins[d], x, y, float(c.agents.angles[e, a])
        )
        assert float(found.straight[e, a]) == pytest.approx(straight, rel=1e-5)
        assert found.bearing[e, a].tolist() == pytest.approx([straight / 10, *bearing], abs=2e-3)
        assert float(found.distance[e, a]) == pytest.approx(distance, rel=1e-4)
        assert found.descent[e, a].tolist() == pytest.approx(descent.tolist(), abs=2e-2)
        n_infinite += math.isinf(distance)
    assert 0 < n_infinite < n


def test_ahead_left_behind_and_right(device):
    """A goal two metres to the north of four agents that look east, north, west and south."""
    c = boxes(device, 4)
    c.agents.positions.fill_(1.5)
    c.agents.angles.copy_(torch.tensor([[0.0], [90.0], [180.0], [270.0]]))
    points = 3 * [np.array([[1.5, 3.5]])]
    field = 10 - np.arange(30, dtype=np.float16)[:, None] / 10 + np.zeros((1, 30, 30), np.float16)
    made = engine.DistanceFields(points, 3 * [field], 3 * [np.ones(2)], CELL, device)
    goals = torch.zeros((4, 1), dtype=torch.int32, device=device)
    found = engine.to_goal(c.scenery, c.agents, made, goals)
    turned = [[0, 1], [1, 0], [0, -1], [-1, 0]]
    assert found.bearing[:, 0].tolist() == [
        pytest.approx([0.2, *way], abs=1e-3) for way in turned
    ]
    assert found.descent[:, 0].tolist() == [pytest.approx(way, abs=0.1) for way in turned]
    assert found.distance[:, 0].tolist() == pytest.approx(4 * [9.5], abs=1e-2)
    c.agents.positions.copy_(torch.tensor([1.5, 3.5]))
    there = engine.to_goal(c.scenery, c.agents, made, goals)
    assert there.bearing[:, 0].tolist() == 4 * [[0, 1, 0]] and not there.straight.any()


@pytest.mark.parametrize("goal", [5, -1, 2**31 - 1])
def test_a_goal_that_is_none_is_named_and_others_go_on(goal, device):
    c = boxes(device, 4)
    c.agents.positions.fill_(1.5)
    made = engine.DistanceFields(*fields_of(np.random.default_rng(1)), CELL, device)
    goals = torch.zeros((4, 1), dtype=torch.int32, device=device)
    right = engine.to_goal(c.scenery, c.agents, made, goals)
    goals[3] = goal
    found = right
    with pytest.raises(engine.EngineError, match="environment 3 has a goal that its layout does"):
        found = engine.to_goal(c.scenery, c.agents, made, goals)
        engine.check(c.agents)
    assert all(torch.equal(a[:3], b[:3]) for a, b in zip(found, right))


def test_half_precision_is_read_as_pytorch_reads_it(device):
    """Every half but the NaNs, as the value of a field of one number."""
    bits = torch.arange(2**15, dtype=torch.int32).to(torch.int16)[: 0x7C01].view(torch.float16)
    c = core.Core(scene.scenery([toys.box(3)], 1, len(bits), device=device), res=8)
    c.agents.positions.fill_(1.05)
    fields = np.repeat(bits.numpy()[:, None], 4, 1).reshape(-1, 2, 2)
    made = engine.DistanceFields(
        [np.ones((len(bits), 2))], [fields], [np.ones(2)], CELL, device
    )
    goals = torch.arange(len(bits), dtype=torch.int32, device=device)[:, None]
    found = engine.to_goal(c.scenery, c.agents, made, goals).distance.cpu().flatten()
    torch.testing.assert_close(found, bits.float(), rtol=1e-6, atol=0)


def test_fields_that_do_not_fit_are_refused():
    points, fields, origins = fields_of(np.random.default_rng(1))
    with pytest.raises(ValueError, match="points must be one array"):
        engine.DistanceFields(points[:2], fields, origins, CELL)
    with pytest.raises(ValueError, match="float16 .* at least 2 x 2 cells, but one is float64"):
        engine.DistanceFields(points, [fields[0].astype(float), *fields[1:]], origins, CELL)
    with pytest.raises(ValueError, match="at least 2 x 2"):
        engine.DistanceFields(points, [fields[0][:, :1], *fields[1:]], origins, CELL)
    two = engine.DistanceFields(points[:2], fields[:2], origins[:2], CELL)
    c = boxes("cpu", 2)
    with pytest.raises(ValueError, match="fields must be of the scenery's 3 layouts .* 2 on cpu"):
        engine.to_goal(c.scenery, c.agents, two, torch.zeros((2, 1), dtype=torch.int32))


# ---- RandomGoals ----


def world(geometries, n_envs, device="cpu", n_agents=1, **settings):
    c = core.Core(scene.scenery(geometries, n_agents, n_envs, device=device), res=8)
    goals = modules.RandomGoals(geometries, c, **settings)
    spawner = modules.RandomSpawns(geometries, c, resample=True, points=goals.spawns)
    return c, goals, spawner


@pytest.mark.parametrize("n_agents", [1, 2])
def test_goals_are_in_range_and_lengths_are_theirs(n_agents, device):
    homes = [*sample("homes", 3), toys.column()]
    c, goals, spawner = world(homes, 300, device, n_agents, nearest=2.0, furthest=4.0)
    everyone = c.agent_full(True)
    truth = [
        ways.geodesics(
            g, 128, 16, c.agents.radius, np.random.Generator(np.random.Philox([c.seed, d]))
        )
        for d, g in enumerate(homes)
    ]
    chosen = set()
    for _ in range(3):
        spawner(everyone)
        goals(everyone, spawner.chosen)
        assert 2 <= goals.lengths.min() and goals.lengths.max() <= 4
        for e, a in np.ndindex(100, n_agents):
            d, goal = int(c.scenery.layout[e]), int(goals.chosen[e, a])
            place = c.agents.positions[e, a].cpu().numpy()
            (spawn,) = np.unique((truth[d].spawns == place).all(1).nonzero()[0][:1])
            assert float(goals.lengths[e, a]) == truth[d].lengths[spawn, goal]
            at = goals.fields.points[d, goal].cpu().numpy()
            assert (at == truth[d].goals[goal]).all()
            chosen.add((d, goal))
    assert len(chosen) > 40, "of 64"


def test_only_those_that_reset_get_another_goal():
    homes = sample("homes", 2)
    c, goals, spawner = world(homes, 64)
    everyone = c.agent_full(True)
    spawner(everyone)
    goals(everyone, spawner.chosen)
    before = goals.chosen.clone(), goals.lengths.clone()
    some = everyone & (torch.arange(64) % 2 == 0)[:, None]
    spawner(some)
    goals(some, spawner.chosen)
    changed = (goals.chosen != before[0]) | (goals.lengths != before[1])
    assert not changed[1::2].any() and changed[::2].float().mean() > 0.8


@pytest.mark.parametrize(
    "range_, words",
    [
        (dict(nearest=40.0, furthest=50.0), r"geometry \d+ has no goal from 40 to 50 m .* [\d.]+ m"),
        (dict(nearest=3.0, furthest=3.0), "0 <= nearest < furthest"),
        (dict(nearest=-1.0), "0 <= nearest < furthest"),
    ],
)
def test_a_range_without_goals_is_refused(range_, words):
    with pytest.raises(ValueError, match=words):
        world([toys.box(5)], 2, **range_)


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
    boxes_ = [room(width=2 + 0.01 * i, height=1.5, id=i) for i in range(workers.MANY)]
    found = all_of(boxes_)
    assert "shortest ways in 48 layouts" in capfd.readouterr().err
    monkeypatch.setattr(workers, "MANY", 1000)
    monkeypatch.setenv("MEGASTEP_CACHE", str(folder / "other"))
    alone = all_of(boxes_)
    assert all((x == y).all() for a, b in zip(found, alone) for x, y in zip(a, b))


def test_an_error_in_a_process_names_the_geometry(folder):
    boxes_ = [room(width=2 + 0.01 * i, height=1.5, id=i) for i in range(workers.MANY)]
    boxes_[40]["masks"] = boxes_[40].masks * 0
    with pytest.raises(ValueError, match="geometry 40 has no room to spawn in"):
        all_of(boxes_)
