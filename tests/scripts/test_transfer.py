"""Robots driven by exported policies outside of megastep: scripts/examples/transfer."""

import gzip
import json
import math
import sys
from pathlib import Path

import episodes
import numpy as np
import pytest
import robot_node
import torch
import transfer
from controllers import FollowPath, Scripted
from robot_policy import RobotPolicy

from megastep import envs, modules, toys
from megastep.agents.export import runtimes
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict

DATA = Path(__file__).parents[1] / "data" / "irsim_messages.json.gz"
ROBOT = modules.Robot(n_rays=32)
ABOUT = dict(
    robot={name: getattr(ROBOT, name) for name in ROBOT.__dataclass_fields__},
    steps_per_second=10.0,
    reach=0.2,
    limit=500,
)


def room(start=(2.0, 2.0, 0.0), goal=(4.0, 2.0), number=0):
    """An episode in a room of 5 m x 5 m from (1, 1) on."""
    at = np.array(start), np.array(goal)
    walls = toys.box().walls.astype(np.float32)
    return episodes.Episode(number, 0, walls, *at, float(np.hypot(*(at[1] - at[0][:2]))))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """An environment with a robot, a policy of random weights for it, and its file."""
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name)
    env = envs.PointGoal(3, [toys.box()], robot=ROBOT, device="cpu", nearest=0.5)
    policy = Policy(env.obs_space, env.action_space, width=16, continuous="beta")
    path = tmp_path_factory.mktemp("robot") / "robot.onnx"
    step = runtimes.Step(policy, env.reset())
    runtimes.save(step, path)
    path.with_suffix(".json").write_text(json.dumps(runtimes.description(step, env)))
    return env, policy, path


# ---- The policy outside ----


@pytest.mark.slow
def test_the_description_is_enough_to_act_as_the_policy_does(exported):
    """From metres, m/s and rad/s; observations in megastep are rounded to float16."""
    env, policy, path = exported
    outside, world, state = RobotPolicy(path), env.reset(), policy.initial(3)
    outside.begin(seed=None)
    assert (outside.about["steps_per_second"], outside.about["limit"]) == (10.0, 500)
    n_steps = 0
    while n_steps < 25 and not world.terminal[0]:
        n_steps += 1
        ranges = env.lidar.ranges()[0, 0].numpy()
        angle = math.radians(env.core.agents.angles[0, 0])
        pose = np.array([*env.core.agents.positions[0, 0].tolist(), angle])
        goal = env.goals.points[0, env.goal_index[0]].numpy()
        command = outside.act(
            ranges, env.movement.twist()[0, 0].numpy(), episodes.to_robot(pose, goal)
        )
        decision, state = policy(world, state, sample=False)
        expected = decision.actions[0, 0].detach()
        np.testing.assert_allclose(command, expected, atol=0.02)
        world = env.step(arrdict(actions=decision.actions.detach() + torch.tensor([0.1, 0.6])))
    assert n_steps > 5


@pytest.mark.slow
def test_actions_are_drawn_from_the_policys_distribution(exported):
    """Their mean is its action without draws, and their spread that of the Beta distribution."""
    env, policy, path = exported
    outside, seen = RobotPolicy(path), (np.full(32, 2.0), np.array([0.2, 0.5]), np.array([3, 1.0]))

    def acted(seed):
        outside.begin(seed)
        return outside.act(*seen)

    drawn, limits = np.array([acted(seed) for seed in range(600)]), [ROBOT.speed, ROBOT.turn_rate]
    np.testing.assert_array_equal(acted(7), drawn[7])
    world = arrdict(reset=torch.ones(1, dtype=torch.bool))
    scan = torch.full((1, 1, 1, 1, 32), 1 - 2 / 12)
    odom = torch.tensor([[[0.2 / 0.46, 0.5 / 1.9]]])
    goal = torch.tensor([[[10**0.5 / 10, 3 / 10**0.5, 1 / 10**0.5]]])
    world["obs"] = arrdict(scan=scan, odom=odom, goal=goal)
    alpha, beta = policy(world, policy.initial(1))[0].logits[0, 0].detach().chunk(2)
    expected = torch.distributions.Beta(alpha, beta)
    np.testing.assert_allclose(drawn.mean(0) / limits, 2 * expected.mean - 1, atol=0.08)
    np.testing.assert_allclose(drawn.std(0) / limits, 2 * expected.stddev, rtol=0.1)
    np.testing.assert_allclose(acted(None) / limits, 2 * expected.mean - 1, atol=1e-4)


@pytest.mark.slow
def test_a_policy_of_other_inputs_is_refused(tmp_path, exported):
    about = json.loads(exported[2].with_suffix(".json").read_text())
    about["inputs"][0]["name"] = "obs.d"
    (tmp_path / "a.onnx").write_bytes(exported[2].read_bytes())
    (tmp_path / "a.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match="takes obs.d, obs.odom, .*; a robot's policy takes obs.s"):
        RobotPolicy(tmp_path / "a.onnx")


@pytest.mark.slow
def test_rays_are_the_nearest_of_another_scan(exported):
    """A scan of 64 rays from the rear on, and one of the half ahead, for 32 rays from ahead on."""
    policy = RobotPolicy(exported[2])
    increment = 2 * math.pi / 64
    ranges = policy.resampled(np.arange(64.0), -math.pi, increment)
    np.testing.assert_array_equal(ranges, (32 + 2 * np.arange(32)) % 64)
    half = policy.resampled(np.arange(33.0), -math.pi / 2, increment)
    expected = np.where(np.arange(32) <= 8, 16 + 2 * np.arange(32), np.inf)
    expected[24:] = 2 * np.arange(8)
    np.testing.assert_array_equal(half, expected)


# ---- The node, on messages of IR-SIM ----


@pytest.fixture
def recorded():
    """An episode's start in IR-SIM: its walls, its lidar's yaw, and messages."""
    return json.loads(gzip.decompress(DATA.read_bytes()))


@pytest.mark.slow
def test_a_node_sees_in_messages_what_megastep_sees_there(recorded, exported):
    policy = RobotPolicy(exported[2])
    policy.scan = dict(policy.scan, n_rays=128, angle_increment=2 * math.pi / 128)
    node = robot_node.RobotNode(policy, (0.0, 0.0), recorded["lidar_yaw"])
    in_megastep = pytest.importorskip("in_megastep")
    world = in_megastep.InMegastep(dict(ABOUT["robot"], n_rays=128), 10.0)
    speeds = []
    for messages in recorded["messages"]:
        node.on_scan(messages["scan"])
        node.on_odometry(messages["odometry"])
        _, pose, twist = node.odometry
        walls = np.array(recorded["walls"], np.float32)
        world.begin(episodes.Episode(0, 0, walls, pose, np.zeros(2), 1.0))
        np.testing.assert_allclose(node.scan[1], world.sense(), atol=2e-3)
        speeds.append(twist)
    steps = np.diff([_pose(one["odometry"]) for one in recorded["messages"]], axis=0)
    moved = np.hypot(*steps[:, :2].T) / 0.1
    np.testing.assert_allclose(moved, np.abs(np.array(speeds)[1:, 0]), atol=0.03)
    np.testing.assert_allclose(steps[:, 2] / 0.1, np.array(speeds)[1:, 1], atol=0.05)


def _pose(odometry):
    place, turn = odometry["pose"]["pose"]["position"], odometry["pose"]["pose"]["orientation"]
    return place["x"], place["y"], 2 * math.atan2(turn["z"], turn["w"])


@pytest.mark.slow
def test_a_node_drives_and_stops_at_its_goal_and_in_silence(recorded, exported):
    policy = RobotPolicy(exported[2])
    lines = [json.dumps(one) for one in recorded["messages"]]
    node = robot_node.RobotNode(policy, (50.0, 0.0), recorded["lidar_yaw"])
    assert not node.tick(0.0).any(), "before it heard anything"
    commands = [command for _, command in robot_node.replay(node, lines)]
    assert all(np.abs(command).max() > 0 for command in commands) and len(commands) == len(lines)
    at = node.odometry[0]
    assert node.tick(at + 0.4).any() and not node.tick(at + 0.6).any()
    node.goal = node.odometry[1][:2] + 0.1
    assert not node.tick(at).any()


@pytest.mark.slow
def test_a_node_reads_rays_without_a_return(exported):
    """inf, NaN, 0 and beyond range_max are none; -inf and below range_min are near."""
    node = robot_node.RobotNode(RobotPolicy(exported[2]), (1.0, 0.0))
    ranges = [math.inf, math.nan, 0.0, 13.0, 0.1, 0.2, *[5.0] * 26]
    node.on_scan(
        dict(
            header=dict(stamp=1.0),
            angle_min=0.0,
            angle_increment=2 * math.pi / 32,
            range_min=0.15,
            range_max=12.0,
            ranges=ranges,
        )
    )
    expected = [math.inf] * 4 + [0.0, 0.2] + [5.0] * 26
    np.testing.assert_array_equal(node.scan[1], expected)


# ---- Episodes and tables ----


def test_episodes_are_those_of_the_environment(tmp_path):
    episodes.write("homes", str(tmp_path / "a.npz"), 6, 3, 1, dict(radius=0.17))
    found = episodes.read(str(tmp_path / "a.npz"))
    assert len(found) == 6 and len({one.home for one in found}) == 3
    for one in found:
        straight = np.hypot(*(one.goal - one.start[:2]))
        assert 1 <= one.shortest <= 15 and straight <= one.shortest + 1e-3
        assert np.ptp(one.walls.reshape(-1, 2), axis=0).min() > 3


@pytest.mark.parametrize("name", transfer.SIMULATORS)
def test_a_robot_drives_alike_in_every_simulator(name):
    """One metre ahead, then a quarter turn; then it pushes against the wall at 6 m."""
    pytest.importorskip({"megastep": "megastep", "irsim": "irsim", "mujoco": "mujoco"}[name])
    world = transfer.simulator(name, ABOUT)
    world.begin(room())
    np.testing.assert_allclose(world.sense()[[0, 8, 16, 24]], [4, 4, 1, 1], atol=0.01)
    assert not any(world.drive([0.4, 0.0]) for _ in range(25))
    np.testing.assert_allclose(world.pose(), [2.9, 2.0, 0.0], atol=0.08)
    np.testing.assert_allclose(world.twist(), [0.4, 0.0], atol=0.03)
    assert not any(world.drive([0.0, 1.0]) for _ in range(16))
    assert world.pose()[2] == pytest.approx(1.5, abs=0.2), "wheels slip while they turn"
    assert not any(world.drive([0.0, -1.0]) for _ in range(16))
    touches = [world.drive([0.46, 0.0]) for _ in range(90)]
    assert not any(touches[:40]) and all(touches[-10:])
    assert world.pose()[0] == pytest.approx(6 - 0.17, abs=0.02)


def test_controllers_reach_goals_in_the_open():
    corner = np.array([[2.0, 2.0], [2.0, 4.0], [4.0, 4.0]])
    world, robot = transfer.simulator("megastep", ABOUT), ABOUT["robot"]
    for driver, length in (
        (Scripted(robot), 8**0.5),
        (FollowPath(robot, lambda episode: corner), 4.0),
        (FollowPath(robot, lambda episode: None), 8**0.5),
    ):
        outcome = transfer.play(world, driver, room(goal=(4.0, 4.0)), ABOUT)
        assert outcome["success"] == 1 and outcome["collisions"] == 0
        walked = 2 * 2**0.5 / outcome["spl"]
        assert walked == pytest.approx(length, abs=0.45)
        assert outcome["seconds"] == pytest.approx(walked / 0.46, abs=5)


def test_the_table_pairs_episodes(tmp_path, monkeypatch, capsys):
    rows = []
    for i in range(40):
        for name, success in (("megastep", 1.0), ("irsim", float(i % 4 > 0))):
            row = dict(driver="a", simulator=name, episode=i, home=i // 2, success=success)
            rows.append(dict(row, spl=success / 2, collisions=2, seconds=5.0, ms=0.5))
    (tmp_path / "a.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows[:-2]))
    monkeypatch.setattr(sys, "argv", ["transfer.py", str(tmp_path / "a.npz"), "--table"])
    transfer.main()
    first, second = capsys.readouterr().out.splitlines()[-2:]
    assert first.startswith(
        "| a | megastep | 39 | 1 (1 to 1) | 0.5 (0.5 to 0.5) | 2 (2 to 2) | 5.0"
    )
    assert "-25.6 (-" in second and "points" in second
    mean, low, high = transfer.interval([0, 1, 0, 1], [0, 0, 1, 1])
    assert (mean, low, high) == (0.5, 0.5, 0.5), "homes are alike"


# ---- Bad input ----


@pytest.mark.slow
def test_what_is_missing_is_named_in_a_sentence(tmp_path, monkeypatch, capsys, exported):
    def ending(module, *words):
        monkeypatch.setattr(sys, "argv", ["x.py", *map(str, words)])
        with pytest.raises(SystemExit) as error:
            module.main()
        return error.value.code, capsys.readouterr().err

    monkeypatch.setitem(sys.modules, "irsim", None)
    sys.modules.pop("in_irsim", None)
    path = tmp_path / "a.npz"
    episodes.write("homes", str(path), 2, 1, 1, dict(radius=0.17))
    code, text = ending(transfer, path, "--policy", exported[2], "--simulators", "irsim")
    assert code == 2 and text == (
        "transfer.py: irsim is not installed (irsim is missing): pip install ir-sim\n"
    )
    code, text = ending(transfer, path)
    assert code == 2 and "--policy is missing" in text
    code, text = ending(transfer, path, "--policy", tmp_path / "none.onnx")
    assert code == 2 and "none.json" in text and text.count("\n") == 1
    with pytest.raises(ValueError, match="fits through no door"):
        episodes.write("homes", str(path), 2, 1, 1, dict(radius=0.5))


@pytest.mark.slow
def test_a_policy_without_a_lidar_makes_no_node(exported):
    policy = RobotPolicy(exported[2])
    policy.scan = None
    with pytest.raises(ValueError, match="the policy has no scan"):
        robot_node.RobotNode(policy, (0, 0))
