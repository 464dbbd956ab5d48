"""Movable objects as an environment's author uses them: pushed, grabbed, locked."""

import re
from pathlib import Path

import pytest
import torch

from megastep import engine, modules, scene, toys
from megastep.core import Core
from megastep.engine.state_tree import restore, snapshot
from megastep.modules import Crate, Disc, Objects, Ramp
from tests.helpers import bodies

PAGE = Path(__file__).parents[2] / "docs/objects.md"
AHEAD, TURN_LEFT, STAND = 3, 5, 0


def room(kinds, n_envs=2, n_agents=1, device="cpu", **arguments):
    """Agents at (2, 3) that look along x, in a room of 5 m, and objects that are placed nowhere."""
    plans = [toys.box()]
    core = Core(scene.scenery(plans, n_agents, n_envs, device=device))
    objects = Objects(plans, core, kinds, **arguments)
    core.agents.positions.copy_(torch.tensor([2.0, 3.0]))
    core.agents.positions[..., 1] += 0.5 * torch.arange(n_agents, device=device)
    movement = modules.SimpleMovement(core, speed=1.0, ang_speed=45.0)
    return (
        core,
        objects,
        lambda *actions: movement({"actions": torch.tensor([actions] * n_envs, device=device)}),
    )


def put(kind, *at):
    kind.visible.fill_(True)
    kind.positions.copy_(torch.tensor([at], device=kind.positions.device))


def test_the_example_of_the_page_brings_every_ball_into_the_goal(capsys):
    section = PAGE.read_text().split("## Something to push")[1]
    exec(re.search(r"```python\n(.*?)```", section, re.S)[1], {})
    assert capsys.readouterr().out == "100% of the balls are in the goal\n"


def test_what_is_grabbed_goes_and_turns_with_its_holder_until_released(device):
    core, objects, act = room({"box": Crate(2, 0.3, movable=True)}, device=device)
    boxes = objects["box"]
    put(boxes, (2.35, 3.0), (5.0, 5.0))
    boxes.grab(boxes.touching(0.1))
    assert boxes.held().tolist() == [[[True, False]]] * 2
    for _ in range(20):
        act(TURN_LEFT)  # by 90 degrees in all
    torch.testing.assert_close(
        boxes.positions[:, 0].cpu(), torch.tensor([[2, 3.35]] * 2), rtol=0, atol=0.05
    )
    torch.testing.assert_close(boxes.angles[:, 0].cpu(), torch.full((2,), 90.0), rtol=0, atol=3)
    for _ in range(10):
        act(4)  # back, away from the box
    assert (boxes.positions[:, 0, 1] < 2.7).all()
    boxes.release(torch.ones((2, 1), dtype=torch.bool, device=device))
    at = boxes.positions[:, 0, 1].clone()
    for _ in range(5):
        act(4)
    assert (at - boxes.positions[:, 0, 1] < 0.2).all() and (boxes.holders == -1).all()


def test_an_agent_loses_what_is_too_heavy_or_put_elsewhere():
    core, objects, act = room({"box": Crate(1, 0.3, movable=True)}, grip=8.0)
    box = objects["box"]
    put(box, (2.35, 3.0))
    box.masses[0], box.masses[1] = 0.5, 4.0  # friction of 2.5 and 20 newtons
    box.grab(box.touching(0.1))
    for _ in range(10):
        act(4)  # back
    assert box.holders.tolist() == [[0], [-1]]
    assert box.positions[0, 0, 0] < 1.8 and box.positions[1, 0, 0] > 2.2
    core.agents.positions[:, 0] = box.positions[:, 0] - torch.tensor([0.35, 0])
    box.grab(torch.ones((2, 1, 1), dtype=torch.bool))
    act(STAND)
    box.positions[0] += 1
    act(STAND)
    assert box.holders.tolist() == [[-1], [0]]
    spawner = modules.RandomSpawns([toys.box()], core)
    spawner(torch.ones(2, dtype=torch.bool))
    assert (box.holders == -1).all(), "who respawns lets go"


def test_nobody_moves_what_is_locked_and_its_team_alone_unlocks_it(device):
    core, objects, act = room({"box": Crate(1, 0.3, movable=True)}, device=device)
    box, everywhere = objects["box"], torch.ones(2, dtype=torch.bool, device=device)
    put(box, (2.35, 3.0))
    box.grab(box.touching(0.1))
    nobody = torch.full((2, 1), -1, device=device)
    box.lock(everywhere, team=nobody)
    assert not box.locked.any() and (box.holders == 0).all()
    with pytest.raises(ValueError, match="team must be an integer of at least 0"):
        box.lock(everywhere, team=-1)
    box.lock(everywhere, team=nobody + 2)
    box.lock(everywhere, team=0)  # too late
    assert (box.owners == 1).all() and (box.holders == -1).all()
    box.grab(box.touching(0.1))
    before = box.positions.clone()
    for _ in range(10):
        progress = act(AHEAD).progress
    assert torch.equal(before, box.positions) and (progress < 0.1).all()
    assert (box.holders == -1).all(), "nor grabs it"
    box.unlock(everywhere, team=0)
    assert box.locked.all()
    box.unlock(everywhere, team=1)
    for _ in range(10):
        act(AHEAD)
    assert (box.positions[..., 0] > 2.6).all() and (box.owners == -1).all()
    box.movable.fill_(False)
    before = box.positions.clone()
    for _ in range(10):
        act(AHEAD)
    assert torch.equal(before, box.positions)


def test_an_agent_drives_up_a_ramp_and_over_boxes_up_to_the_wall(device):
    """From the low side alone: from the other three it pushes the ramp."""
    kinds = {"ramp": Ramp(1), "box": Crate(1, 0.4, movable=True)}
    core, objects, act = room(kinds, n_envs=4, device=device, ramp_steps=8)
    ramp, box, elevated = objects["ramp"], objects["box"], objects.all.elevated
    put(ramp, (2.6, 3.1))
    put(box, (3.2, 3.0))
    ramp.angles[:, 0] = torch.tensor([0.0, 90, 180, -90])
    ups = [elevated[:, 0].tolist() for _ in range(50) if act(AHEAD)]
    first = ups.index([8, 0, 0, 0])
    assert [up for up, *_ in ups[first:]] == [*range(8, 0, -1)] + [0] * (42 - first)
    assert {up for up, *_ in ups[:first]} == {0, -1} and not any(map(any, (u[1:] for u in ups)))
    way = (ramp.positions - torch.tensor([2.6, 3.1], device=device)).norm(dim=-1)[:, 0]
    assert way[0] == 0 and (way[1:] > 0.3).all()
    assert torch.equal(box.positions[0].cpu(), torch.tensor([[3.2, 3.0]]))
    gap = 6 - core.agents.radius - core.agents.positions[0, 0, 0]
    assert gap.item() == pytest.approx(0, abs=6e-3)


def test_who_is_over_a_box_stays_elevated_and_comes_down_with_a_new_episode(device):
    kinds = {"ramp": Ramp(1), "box": Crate(1, 1.5, movable=True)}
    core, objects, act = room(kinds, device=device, ramp_steps=2)
    elevated = objects.all.elevated
    put(objects["ramp"], (2.5, 3.0))
    put(objects["box"], (3.6, 3.0))
    for _ in range(15):
        act(AHEAD)
    assert elevated.eq(1).all() and core.agents.positions[..., 0].sub(3.5).abs().max() < 0.1
    saved = snapshot((core, objects))
    ends = []
    for _ in "ab":
        restore((core, objects), saved)
        ends.append([(act(AHEAD), elevated.clone())[1] for _ in range(12)])
    assert all(map(torch.equal, *ends)) and ends[0][0].all() and not ends[0][-1].any()
    assert (objects["box"].positions[..., 0] == 3.6).all()
    restore((core, objects), saved)
    only_first = torch.tensor([True, False], device=device)
    modules.RandomSpawns([toys.box()], core)(only_first)
    assert elevated.tolist() == [[0], [1]]


@pytest.mark.parametrize("may_grab", [False, True])
def test_an_elevated_agent_rides_on_a_box_if_it_may_grab(may_grab):
    kinds = {"ramp": Ramp(1, width=0.2), "box": Crate(2, 0.4, movable=True, mass=0.5)}
    core, objects, act = room(kinds, ramp_steps=2, grab_elevated=may_grab)
    box, elevated = objects["box"], objects.all.elevated
    put(objects["ramp"], (2.6, 3.0))
    put(box, (3.1, 2.9), (2.0, 3.33))
    box.grab(torch.tensor([[False, True]]).expand(2, 1, 2))
    for _ in range(12):
        act(AHEAD)
    assert elevated.eq(1).all() and box.held()[..., 1].eq(may_grab).all()
    box.release(torch.ones((2, 1), dtype=torch.bool))
    box.grab(torch.tensor([[True, False]]).expand(2, 1, 2))
    for _ in range(12):
        act(AHEAD)
    assert (box.positions[:, 0, 0] > 4).eq(may_grab).all() and elevated.eq(int(may_grab)).all()


def test_agents_that_come_down_in_bodies_are_pushed_out_slowly():
    """As an environment may have them, also in those that are locked."""
    scenery, agents, random = bodies.world(64, "ramps", seed=4)
    o, depths = scenery.objects, []
    inside = torch.rand((64, 3, 2), generator=random) - 0.5
    agents.positions.copy_(o.positions[:, :3] + 0.2 * inside)
    o.locked.copy_(torch.rand(o.locked.shape, generator=random) < 0.3)
    for _ in range(60):
        before, places = agents.positions.clone(), o.positions.clone()
        moves = torch.randint(9, (64, 3), generator=random)
        engine.physics(scenery, agents, moves, bodies.MOVES, 0.5)
        depths.append(bodies.overlaps(scenery, agents).amax())
        assert (agents.positions - before).norm(dim=-1).max() < 0.25  # 1.1 m/s, and 4 x 2 cm
        assert (o.positions - places).norm(dim=-1).max() < 0.2
    assert depths[0] > 0.2 and depths[30] < depths[0] / 2 and depths[-1] < 0.006


def test_placed_objects_rest_and_keep_clear_corners_included():
    kinds = {"box": Crate(4, 0.6, movable=True, width=0.2), "ball": Disc(2, 0.2, movable=True)}
    core, objects, act = room(kinds, n_envs=64)
    everywhere = torch.ones(64, dtype=torch.bool)
    for kind in objects.kinds.values():
        kind.velocity.fill_(1)
        kind.holders.fill_(0)
        kind.locked.fill_(True)
        kind.place(everywhere)
        assert not kind.velocity.any() and (kind.holders == -1).all() and not kind.locked.any()
    positions = objects.all.positions
    radii = torch.tensor([0.1**0.5] * 4 + [0.2] * 2)
    apart = torch.cdist(positions, positions) + 9 * torch.eye(6)
    assert (apart > radii + radii[:, None]).all()
    assert objects["box"].masses.eq(1).all() and objects.all.widths[0].item() == pytest.approx(
        1 / 3
    )


def test_cameras_see_an_elongated_box_where_it_was_pushed():
    core, objects, act = room({"box": Crate(1, 1.0, movable=True, width=0.2)}, n_envs=1)
    box = objects["box"]
    put(box, (2.5, 3.0))
    box.angles.fill_(90)  # across
    for _ in range(10):
        act(AHEAD)
        view = engine.render(core.scenery, core.agents)
        middle = view.distances[0, 0, view.distances.shape[-1] // 2]
        front = box.positions[0, 0, 0] - 0.1 - core.agents.positions[0, 0, 0]
        assert middle.item() == pytest.approx(front.item(), abs=5e-3)
    assert box.positions[0, 0, 0] > 2.8
    assert box.touching(0.05).all() and not box.touching(0.001).all()


@pytest.mark.parametrize(
    "kinds, message",
    [
        ({"box": Crate(17, 0.1, movable=True)}, "at most 16 movable objects, but 17"),
        ({"box": Crate(1, movable=True, mass=1e39)}, "mass of box must be a number of kg between"),
        ({"box": Crate(1, movable=True, mass=0)}, "mass of box must be a number of kg between"),
        ({"box": Crate(1, movable=True, friction=-1)}, "friction of box must be a number between"),
        (
            {"box": Crate(1, 30.0, movable=True, width=1.0), "ramp": Ramp(1)},
            "geometry 0 has no point in a room that is .* from every wall: make box 0 smaller",
        ),
        ({"box": Crate(1, 1.0, width=2.0)}, "width of box must be a number between 0 and 1"),
        ({"ramp": Ramp(9), "box": Crate(8, 0.1, movable=True)}, "at most 16 movable objects, but"),
        ({"ramp": Ramp(1, width=0.7)}, "width of ramp must be a number between 0 and 0.6"),
    ],
)
def test_bad_kinds_are_named(kinds, message):
    with pytest.raises(ValueError, match=message):
        room(kinds)


def test_bad_calls_are_named():
    core, objects, act = room({"box": Crate(16, 0.1, movable=True)}, n_agents=17)
    with pytest.raises(ValueError, match="at most 32 agents and movable objects together"):
        act(*[STAND] * 17)
    _, objects, _ = room({"key": 1})
    with pytest.raises(AttributeError, match="key has no attribute 'masses' .only kinds with"):
        _ = objects["key"].masses
    _, objects, _ = room({"box": Crate(1, movable=True)})
    with pytest.raises(ValueError, match="team must be an integer of at least 0, but -1"):
        objects["box"].lock(torch.ones(2, dtype=torch.bool), -1)
    with pytest.raises(ValueError, match="force must be a number of newtons"):
        room({"box": Crate(1, movable=True)}, force=-1.0)
