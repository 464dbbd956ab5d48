"""Objects as an environment's author uses them."""

import numpy as np
import pytest
import torch

from megastep import capture, engine, modules, plotting, scene
from megastep.arrdict import numpyify
from megastep.colour import gamma_encode
from megastep.core import Core
from megastep.engine.objects import NUMBERS
from megastep.geometries import sample, toys
from megastep.geometry import mirror_image
from megastep.modules import Crate, Disc, Door, Objects

N, A = 8, 2


def make(kinds, device="cpu", source="homes", n_agents=A, n_envs=N, **arguments):
    plans = sample(source, 4)
    core = Core(scene.scenery(plans, n_agents, n_envs, device=device))
    spawner = modules.RandomSpawns(plans, core, resample=True)
    objects = Objects(plans, core, kinds, **arguments)
    spawner(torch.ones(n_envs * n_agents, dtype=torch.bool, device=device))
    return core, spawner, objects


def everywhere(core):
    return torch.ones(core.n_envs, dtype=torch.bool, device=core.device)


def reachable(plan, doors, radius=0.1):
    """The rooms' numbers that a disc reaches from one point, by a flood over a grid of 5 cm."""
    segments = np.concatenate([plan.walls, doors]).astype(float)
    step, (height, width) = 0.05, plan.masks.shape
    rows, columns = int(height * plan.res / step), int(width * plan.res / step)
    y, x = (np.mgrid[:rows, :columns] + 0.5) * step
    points = np.stack([x, y], -1).reshape(-1, 2)
    free = (modules.spawning.distances(points, segments) > radius).reshape(rows, columns)
    cells = plan.masks[
        np.clip(height - 1 - (y / plan.res).astype(int), 0, height - 1),
        np.clip((x / plan.res).astype(int), 0, width - 1),
    ]
    inside = np.argwhere(free & (cells == 1))
    todo, seen = [tuple(inside[len(inside) // 2])], np.zeros_like(free)
    while todo:
        i, j = todo.pop()
        if 0 <= i < rows and 0 <= j < columns and free[i, j] and not seen[i, j]:
            seen[i, j] = True
            todo += [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
    return set(np.unique(cells[seen & (cells > 0)]).tolist())


def test_doors_shut_the_doorways_of_homes():
    """A home without its doors is one; with all of them, and its openings walled up, each room is
    apart.
    """
    for plan in sample("homes", 4):
        rooms = set(range(1, plan.masks.max() + 1))
        assert reachable(plan, np.zeros((0, 2, 2))) == rooms
        shut = reachable(plan, plan.doors)
        assert 1 in shut and len(shut) < len(rooms)


def test_doors_of_each_home_and_of_its_mirror_image():
    core, spawner, objects = make({"key": 2, "door": Door()})
    doors, plans = objects["door"], sample("homes", 4)
    doors.place(everywhere(core))
    for e in range(N):
        plan = plans[int(core.scenery.layout[e])]
        assert int(doors.visible[e].sum()) == len(plan.doors)
        engine.update_objects(core.scenery, core.agents)
        drawn = core.scenery.objects.lines[e, 12:][doors.visible[e]]  # two hexagons come first
        gap = np.abs(np.sort(drawn.numpy(), 1) - np.sort(plan.doors, 1))
        assert gap.max() < 0.0021, "a millimetre longer on either side"
        flipped = mirror_image(plan)
        width = plan.masks.shape[1] * plan.res
        assert np.allclose(np.sort(width - flipped.doors[..., 0]), np.sort(plan.doors[..., 0]))


def test_a_shut_door_stops_an_agent_and_an_open_one_does_not(device):
    core, spawner, objects = make({"door": Door()}, device, n_agents=1)
    doors = objects["door"]
    doors.place(everywhere(core))
    lines = modules.doorways(sample("homes", 4))
    a, b = (torch.as_tensor(lines[int(core.scenery.layout[0])][0][k]) for k in (0, 1))
    across = torch.stack([(a - b)[1], (b - a)[0]]) / (a - b).norm()
    for is_open in (False, True):
        core.agents.positions[0, 0] = (a + b) / 2 + 0.3 * across
        core.agents.velocity[0, 0] = -6 * across
        doors.open.fill_(is_open)
        engine.physics(core.scenery, core.agents)
        side = ((core.agents.positions[0, 0].cpu() - (a + b) / 2) * across).sum()
        assert (side < 0) == is_open


def test_carrying_and_dropping(device):
    core, spawner, objects = make({"key": 3, "crate": Crate(1)}, device)
    keys = objects["key"]
    keys.place(everywhere(core), colours=torch.tensor([0, 1, 2]))
    assert keys.visible.all() and not objects["crate"].visible.any()
    assert keys.colours.tolist() == [[0, 1, 2]] * N
    core.agents.positions[:, 1] = keys.positions[:, 2]
    core.agents.positions[:, 0] = keys.positions[:, 2]
    core.agents.positions[0, 1] = keys.positions[0, 1]
    near = keys.touching()
    assert near[1:, :, 2].all() and near[0, 1, 1] and near[0, 0, 2] and not near[0, 1, 2]
    keys.carry(near)
    assert keys.carriers[0].tolist() == [-1, 1, 0] and (keys.carriers[1:, 2] == 0).all()
    assert torch.equal(keys.carried()[:, 0, 2], everywhere(core))
    assert not keys.touching()[1:, :, 2].any(), "what is carried is out of reach"
    core.agents.positions[:, 0] += 0.01
    engine.update_objects(core.scenery, core.agents)
    assert torch.equal(keys.positions[:, 2], core.agents.positions[:, 0])
    keys.drop(torch.tensor([[True, False]], device=device).expand(N, A))
    assert (keys.carriers[:, 2] == -1).all() and keys.carriers[0, 1] == 1
    keys.remove(everywhere(core))
    assert not keys.visible.any() and (keys.carriers == -1).all()


def test_touching_measures_from_edges():
    core, _, objects = make({"disc": Disc(1, 0.2), "crate": Crate(1, 0.4)}, source="box", n_envs=1)
    radius = core.agents.radius
    for kind in objects.kinds.values():
        kind.visible.fill_(True)
        kind.positions.copy_(torch.tensor([3.0, 3.0]))
    core.agents.positions[0] = torch.tensor([[3.2 + radius + 0.04, 3], [3.2 + radius + 0.06, 3]])
    assert objects["disc"].touching()[0, :, 0].tolist() == [True, False]
    assert objects["crate"].touching()[0, :, 0].tolist() == [True, False]
    objects["crate"].angles.fill_(45)  # whose corner reaches further
    assert objects["crate"].touching()[0, :, 0].tolist() == [True, True]


def test_looked_at_is_what_the_centre_shows(device):
    core, _, objects = make({"key": 2, "crate": Crate(1)}, device, source="box", n_envs=2)
    core.agents.positions.copy_(torch.tensor([[2.0, 3.0], [4.0, 1.0]]))
    core.agents.angles.zero_()
    keys, crates = objects["key"], objects["crate"]
    keys.visible[:, 1] = True
    keys.positions[:, 1] = torch.tensor([3.0, 3.0])
    crates.visible.fill_(True)
    crates.positions.copy_(torch.tensor([3.0, 3.0]))
    crates.visible[1] = False
    view = engine.observe(core.scenery, core.agents, centre_line=True)
    assert keys.looked_at(view.centre_line).tolist() == [
        [[False, False], [False, False]],
        [[False, True], [False, False]],
    ]
    assert crates.looked_at(view.centre_line)[:, 0, 0].tolist() == [True, False]


@pytest.mark.cuda
def test_a_captured_step_with_objects_equals_one_that_is_not():
    def run(is_captured):
        core, spawner, objects = make({"key": 3, "door": Door()}, "cuda")
        keys, doors = objects["key"], objects["door"]

        def step():
            ended = core.agents.positions[:, 0, 0] > 4
            spawner(ended[:, None].expand(-1, A).reshape(-1))
            keys.place(ended, 1)
            doors.place(ended)
            doors.open.logical_or_(doors.touching().any(1))
            keys.carry(keys.touching())
            core.agents.velocity.fill_(1)
            engine.physics(core.scenery, core.agents)
            return engine.observe(core.scenery, core.agents).rgb

        roots = core, spawner, objects
        replay = capture.capture(step, (), roots) if is_captured else step
        return [replay().clone() for _ in range(20)]

    torch.testing.assert_close(run(True), run(False), rtol=0, atol=0)


def test_a_state_is_drawn_with_its_objects():
    core, _, objects = make({"key": 2, "crate": Crate(1), "door": Door()})
    assert not len(core.state(0).objects.shapes)
    objects["key"].place(everywhere(core))
    objects["crate"].place(everywhere(core))
    objects["door"].place(everywhere(core))
    objects["door"].open[:] = True
    state = numpyify(core.state(0))
    assert len(state.lines) == len(core.scenery.layouts.lines[int(core.scenery.layout[0])]), (
        "walls alone"
    )
    assert state.objects.shapes.tolist() == [NUMBERS[s] for s in ("disc", "disc", "crate")]
    figure, plan, _ = plotting.panels()
    Core.plot_state(state, plan)
    image = plotting.rasterise(figure)
    for position, colour in zip(state.objects.positions, state.objects.colours, strict=True):
        column, row = plan.transform.transform(position).astype(int)
        shown = image[len(image) - 1 - row, column]
        assert np.abs(shown - 255 * gamma_encode(colour)).max() < 2


@pytest.mark.parametrize(
    "kinds, source, message",
    [
        ({"key": 0}, "homes", "the number of key must be an integer from 1"),
        ({"key": "disc"}, "homes", "key must be a number, Disc, Crate, Ramp or Door"),
        ({"key": Disc(1, -1.0)}, "homes", "radius of key must be a number between 0"),
        ({"door": Door()}, "maze", "door: none of the geometries has a doorway"),
        ({}, "homes", "kinds must hold at least one"),
        ({"crate": Crate(1, 30.0)}, "homes", "no point in a room"),
    ],
)
def test_bad_kinds_are_named(kinds, source, message):
    with pytest.raises(ValueError, match=message):
        make(kinds, source=source)


def test_bad_calls_are_named():
    core, _, objects = make({"key": 2})
    with pytest.raises(ValueError, match="mask must be a bool tensor"):
        objects["key"].place(torch.ones(3, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"bool tensor of shape \(8, 2\) or \(8, 2, 2\), "):
        objects["key"].carry(torch.ones(N, A, 2))
    with pytest.raises(AttributeError, match=r"write into it: objects\['key'\].solid\[:\] = "):
        objects["key"].solid = torch.ones(N, 2, dtype=torch.bool)
    objects["key"].solid |= torch.ones(N, 2, dtype=torch.bool)
    assert objects.all.solid.all()
    with pytest.raises(ValueError, match="give all kinds to one Objects"):
        Objects([toys.box()] * 4, core, {"crate": Crate(1)})
    geometries = [toys.box(), toys.box(), toys.column()]
    other = Core(scene.scenery(geometries, n_envs=2, device=core.device))
    for given in geometries[:2], geometries * 2:
        message = f"for each of its 3 layouts, but {len(given)} were given: use"
        with pytest.raises(ValueError, match=message):
            Objects(given, other, {"crate": Crate(1)})
        with pytest.raises(ValueError, match=message):
            modules.RandomSpawns(given, other)
    with pytest.raises(ValueError, match="reach must be a number of metres above 0, but -1"):
        objects["key"].touching(-1)
    with pytest.raises(ValueError, match="colours must be of red"):
        make({"key": 2}, colours=["rainbow"])
    objects["key"].place(everywhere(core), colours=99)
    with pytest.raises(engine.EngineError, match=r"key \d has a colour"):
        engine.observe(core.scenery, core.agents)
