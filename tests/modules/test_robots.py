"""Robots: the lidar against brute force, the drive by hand."""

import math

import pytest
import torch

from megastep import engine, envs, modules, scene, toys
from megastep.core import Core
from megastep.geometries import sample
from megastep.modules.robots import headings
from tests.helpers import twin

DT = 0.1  # seconds of a step


def room(**options):
    """One robot in a room of 5 m x 5 m, from (1, 1) on, facing +x."""
    core = Core(scene.scenery([toys.box()], n_agents=1, n_envs=1), **options)
    core.agents.positions[:] = 2.5
    return core


def drive(movement, speed, turn, n=1):
    for _ in range(n):
        physics = movement(dict(actions=torch.tensor([[[speed, turn]]])))
    return physics


# ---- The lidar ----


def test_ranges_are_those_of_brute_force(device):
    """In homes, with angles of all kinds, from points near the ends of walls too."""
    generator, n = torch.Generator().manual_seed(1), 96
    core = Core(scene.scenery(sample("homes", 4), n_agents=1, n_envs=32, device=device))
    walls = [core.scenery.layouts.lines[int(d)].cpu().double() for d in core.scenery.layout]
    ends = [w.flatten(0, 1)[torch.randint(2 * len(w), (2,), generator=generator)] for w in walls]
    weights = 0.02 + 0.96 * torch.rand(32, 1, generator=generator) ** 3
    at = torch.stack(ends).lerp(torch.stack(ends).flip(1), weights[:, None].double())[:, 0]
    at += 0.01 + 0.02 * torch.rand(32, 2, generator=generator)  # off the walls
    core.agents.positions[:, 0] = at.float().to(device)
    core.agents.angles[:, 0] = (torch.rand(32, generator=generator) * 720 - 360).to(device)
    core.agents.angles[:4] = 90.0
    ranges = engine.scan(core.scenery, core.agents, n).cpu().double()
    for e, of_env in enumerate(walls):
        degrees = core.agents.angles[e].cpu().double()[:, None] + torch.arange(n) * 360 / n
        rays = twin.turn(torch.tensor([1.0, 0.0]).double().expand(1, n, 2), degrees)[:, None]
        expected = twin.raycast(of_env, core.agents.positions[e].cpu().double(), rays, 0.0)
        is_close = torch.isclose(ranges[e, 0], expected["distances"][0, 0], rtol=1e-4, atol=1e-4)
        # along a wall rounding decides
        assert (~is_close).sum() <= (2 if e < 4 else 0), f"env {e}"


def test_ray_0_looks_ahead_and_the_others_follow_counter_clockwise():
    """From a point 1 m from the right wall and 2 m from the upper one."""
    core = room()
    core.agents.positions[:] = torch.tensor([5.0, 4.0])
    lidar = modules.Lidar(core, modules.Robot(n_rays=4, range_min=0.0))
    torch.testing.assert_close(lidar.state(0)[0], torch.tensor([1.0, 2.0, 4.0, 3.0]))
    core.agents.angles[:] = 90.0
    torch.testing.assert_close(lidar.state(0)[0], torch.tensor([2.0, 4.0, 3.0, 1.0]))


def test_beyond_its_ranges_a_lidar_reads_infinity(device):
    core = Core(scene.scenery([toys.box()], n_agents=1, n_envs=1, device=device))
    core.agents.positions[:] = 3.5  # the middle
    for low, high, expected, seen in (
        *((0.0, 5.0, 2.5, 0.5), (0.0, 2.4, math.inf, 0.0), (2.6, 5.0, -math.inf, 1.0)),
    ):
        lidar = modules.Lidar(core, modules.Robot(n_rays=4, range_min=low, range_max=high))
        torch.testing.assert_close(lidar.ranges().cpu(), torch.full((1, 1, 4), expected))
        torch.testing.assert_close(lidar().cpu(), torch.full((1, 1, 1, 1, 4), seen))


def test_a_lidar_sees_walls_only():
    core = Core(scene.scenery([toys.box()], n_agents=2, n_envs=1))
    with pytest.raises(ValueError, match="scan sees walls only"):
        engine.scan(core.scenery, core.agents, 8)
    with pytest.raises(ValueError, match="n_rays must be an integer from 1 to 1024"):
        engine.scan(core.scenery, core.agents, 1025)


# ---- The drive ----


def test_speeds_change_by_the_accelerations():
    """At 0.5 m/s^2 and 2 rad/s^2, 0.05 m/s and 0.2 rad/s per step, up to the limits."""
    core = room()
    robot = modules.Robot(speed=0.12, turn_rate=0.5, accel=0.5, turn_accel=2.0)
    movement, twists = modules.DifferentialMovement(core, robot), []
    for _ in range(3):
        drive(movement, 9.0, -9.0)
        twists.append(movement.twist()[0, 0])
    expected = torch.tensor([[0.05, -0.2], [0.1, -0.4], [0.12, -0.5]])
    torch.testing.assert_close(torch.stack(twists), expected)
    drive(movement, 0.0, 0.0, 3)
    torch.testing.assert_close(movement.twist(), torch.zeros(1, 1, 2))


def test_a_turn_and_a_speed_make_a_circle(device):
    """0.4 m/s and 0.8 rad/s: half a turn of radius 0.5 m, to the left, ends 1 m aside."""
    core = Core(scene.scenery([toys.box()], n_agents=1, n_envs=1, device=device))
    core.agents.positions[:] = 2.5
    robot = modules.Robot(accel=1000.0, turn_accel=1000.0)
    movement, n = modules.DifferentialMovement(core, robot), round(math.pi / 0.8 / DT)
    turn = math.pi / (n * DT)
    for _ in range(n):
        movement(dict(actions=torch.tensor([[[0.5 * turn, turn]]], device=device)))
    torch.testing.assert_close(core.agents.positions.cpu(), torch.tensor([[[2.5, 3.5]]]))
    assert abs(abs(float(core.agents.angles)) - 180) < 1e-3


def test_a_contact_stops_a_robot_which_still_turns_and_slides_if_it_may():
    """It drives at 45 degrees into the wall on the right."""
    for slide in (False, True):
        core = room(radius=0.17)
        core.agents.angles[:] = 45.0
        core.agents.positions[:] = torch.tensor([5.5, 2.0])
        robot = modules.Robot(accel=1000.0, turn_accel=1000.0)
        movement = modules.DifferentialMovement(core, robot, slide=slide)
        n_hits = sum(float(drive(movement, 0.46, 0.0).progress) < 1 for _ in range(45))
        assert n_hits > 10
        x, y = core.agents.positions[0, 0].tolist()
        assert 0 < 6 - 0.17 - x < 2e-3
        before = y
        physics = drive(movement, 0.46, 0.0)
        rise = float(core.agents.positions[0, 0, 1]) - before
        assert physics.progress < 1
        assert rise == pytest.approx(0.046 / math.sqrt(2) if slide else 0.0, abs=2e-3)
        assert float(movement.twist()[0, 0, 0]) == pytest.approx(0.46 if slide else 0.0)
        drive(movement, 0.46, 1.0)
        angle = float(core.agents.angles)
        assert angle == pytest.approx(45 + math.degrees(0.1), abs=1e-3)


def test_headings_are_sine_and_cosine():
    angles = torch.linspace(-720, 720, 99_991)
    radians = torch.deg2rad(angles.double())
    expected = torch.stack([radians.cos(), radians.sin()], -1)
    torch.testing.assert_close(headings(angles).double(), expected, atol=2e-7, rtol=0)


# ---- PointGoal with a robot ----


def test_a_respawned_robot_is_at_rest():
    env = envs.PointGoal(8, [toys.box()], robot=modules.Robot(), limit=5, device="cpu", nearest=0.5)
    world, decision = env.reset(), dict(actions=torch.full((8, 1, 2), 0.4))
    for k in range(1, 13):
        world = env.step(decision)
        assert world.reset.all() == (k % 6 == 0), "a wall or a goal would be an accident"
        assert (world.obs.odom[..., 0] == 0).all() == world.reset.all()


def test_a_robot_that_fits_through_no_door_is_refused():
    with pytest.raises(ValueError, match=r"radius=0.6 m fits through no door of geometry \d+: it"):
        envs.PointGoal(2, sample("homes", 2), robot=modules.Robot(radius=0.6), device="cpu")


def test_a_robot_is_drawn_with_its_ranges_in_metres():
    env = envs.PointGoal(2, sample("homes", 2), robot=modules.Robot(), device="cpu")
    env.reset()
    state = env.state(1)
    torch.testing.assert_close(state.scan, env.lidar.ranges()[1], rtol=0, atol=0)
    assert float(state.core.radius) == pytest.approx(0.17)
    assert env.display(1) is not None
