"""megastep's own wrappers around environments of all kinds."""

import copy

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from megastep import contract, engine, envs, modules, spaces, toys
from megastep.agents.cli import train
from megastep.agents.factory import make, settings
from megastep.arrdict import arrdict
from megastep.capture import Captured
from megastep.geometries import sample
from megastep.modules import Robot
from megastep.wrappers import (
    WRAPPERS,
    ClipReward,
    DropSensor,
    FrameStack,
    Latency,
    NoisyActions,
    NoisySensor,
    OdometryDrift,
    ScaleReward,
    ShapeReward,
    StickyActions,
    TimeLimit,
    Wrapper,
)
from tests.helpers import pages, tiny
from tests.helpers.tiny import TINY

B = 64
DEVICES = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])


class Counting:
    """Observes how many steps an episode has lasted, and the last action. An episode of lane b ends
    after 5 + b % 3 steps. Rewards are the action.
    """

    obs_space = dict(age=spaces.MultiVector(1, 1), did=spaces.MultiVector(1, 1))
    action_space = spaces.MultiDiscrete(1, 4)

    def __init__(self, n_envs=B, device="cpu", seed=1):
        self.n_envs, self.device = n_envs, torch.device(device)
        self.limits = 5 + torch.arange(n_envs, device=device) % 3
        self.ages = torch.zeros(n_envs, dtype=torch.int64, device=device)
        self.ended = torch.ones(n_envs, dtype=torch.bool, device=device)
        self._resets = engine.Resets()

    def reset(self, seed=None, mask=None):
        def begin(chosen):
            return self._world(chosen.clone(), torch.zeros_like(self.ages))

        return self._resets(self, begin, seed, mask)

    def step(self, decision):
        return self._resets.keep(self._world(self.ended.clone(), decision["actions"][:, 0]))

    def _world(self, reset, did):
        self.ages.add_(1).masked_fill_(reset, 0)
        self.ended.copy_(self.ages >= self.limits)
        did = did.float().masked_fill(reset, 0.0)
        return arrdict(
            obs=arrdict(age=self.ages.float().view(-1, 1, 1), did=did.view(-1, 1, 1)),
            reward=did.clone(),
            reset=reset.clone(),
            terminal=self.ended.clone(),
            truncated=torch.zeros_like(reset),
            metrics=arrdict(age=self.ages.float()),
        )


def ones(env):
    return arrdict(actions=torch.ones(env.n_envs, 1, dtype=torch.int64, device=env.device))


def minimal(device="cpu", **settings):
    geometries = [toys.box()]
    return envs.ENVS["minimal"](4, geometries=geometries, res=8, device=device, **settings)


SETTINGS = {
    "clip_reward": {},
    "drop_sensor": dict(sensor="rgb", probability=0.5),
    "frame_stack": dict(n=3),
    "latency": dict(n=2, per_episode=True),
    "noisy_actions": dict(probability=0.5),
    "noisy_sensor": dict(sensor="rgb", per_episode=True),
    "odometry_drift": dict(distance=0.1),
    "scale_reward": dict(factor=0.5),
    "shape_reward": dict(function="tests.envs.test_device_wrappers:length"),
    "sticky_actions": {},
    "time_limit": dict(n=4),
}


def length(world):
    return world.obs.flatten(1).sum(-1) if not isinstance(world.obs, dict) else world.reward + 1


@DEVICES
@pytest.mark.parametrize("name", WRAPPERS)
def test_every_wrapper_keeps_the_contract_and_its_state_is_its_environments(name, device):
    """With masked resets, copies and, on a GPU, a CUDA graph of a step."""
    needs_goal = name == "odometry_drift"
    kind, options = ("pointgoal", dict(limit=5)) if needs_goal else ("explorer", dict(patience=3))
    env = envs.ENVS[kind](8, [toys.box()], res=16, subsample=4, device=device, **options)
    env = WRAPPERS[name](env, **SETTINGS[name])
    contract.rollout(env, 12)
    other = copy.deepcopy(env)
    decision = arrdict(actions=torch.ones(8, 1, dtype=torch.int64, device=device))
    captured = Captured(env) if device == "cuda" else env
    for _ in range(6):
        assert contract.same(captured.step(decision).clone(), other.step(decision))


def test_sticky_actions_repeat_a_quarter_but_never_across_episodes():
    env, n_repeats, n = StickyActions(Counting(), probability=0.25), 0, 0
    world, last = env.reset(), torch.zeros(B)
    for t in range(200):
        chosen = torch.full((B, 1), t % 3 + 1)
        ended = world.terminal
        starts = world.reset
        world = env.step(arrdict(actions=chosen))
        did = world.obs.did.flatten()
        repeated = (did != chosen[:, 0]) & ~ended
        assert bool((did == last)[repeated].all()) and not bool((repeated & starts).any())
        n_repeats, n = n_repeats + int(repeated.sum()), n + int((~ended & ~starts).sum())
        last = torch.where(ended, chosen[:, 0].float(), did)
    assert n_repeats / n == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("per_episode", [False, True])
def test_latency_takes_actions_late_and_none_of_the_episode_before(per_episode):
    """Actions are the step's number. An episode's first actions are 0, as many as its delay."""
    env = Latency(Counting(3000), n=3, per_episode=per_episode)
    world, delays = env.reset(), []
    began = torch.zeros(3000)
    for t in range(1, 40):
        delay = env.delays.clone()
        world = env.step(arrdict(actions=torch.full((3000, 1), t)))
        began = torch.where(world.reset, t, began)
        expected = torch.where(t - delay > began, t - delay, 0).masked_fill(world.reset, 0)
        assert torch.equal(world.obs.did.flatten(), expected.float())
        delays.append(delay)
    shares = torch.stack(delays).flatten().bincount(minlength=4) / (39 * 3000)
    expected = [0.25] * 4 if per_episode else [0, 0, 0, 1]
    assert shares.tolist() == pytest.approx(expected, abs=0.02)


def test_strength_per_episode_is_uniform_and_constant_in_an_episode():
    n = 4000
    noisy = NoisySensor(Counting(n), sensor="age", std=2.0, per_episode=True)
    drops = DropSensor(Counting(n), sensor="age", probability=0.5, per_value=True, per_episode=True)
    for env, mean in ((noisy, 1.0), (drops, 0.25)):
        world, seen, levels = env.reset(), [], []
        for _ in range(60):
            world = env.step(ones(env))
            levels.append(env.levels.values.clone())
            seen.append(world.obs.age.flatten() - env.env.ages)
        levels, seen = torch.stack(levels), torch.stack(seen)
        is_first = (levels[1:] != levels[:-1]).float().mean()
        assert 1 / 9 < is_first < 1 / 5, "episodes have 5 to 7 steps, and one begins them"
        assert levels.min() < 0.01 and levels.max() > 0.99
        assert float(levels.mean()) == pytest.approx(0.5, abs=0.01)
        size = seen.square().mean().sqrt() if env is noisy else (seen != 0).float().mean()
        expected = 2 / 3**0.5 if env is noisy else mean * (6 / 7)  # age 0 stays 0
        assert float(size) == pytest.approx(expected, rel=0.1)
        strong = levels > 0.8
        assert seen[strong].abs().mean() > 3 * seen[levels < 0.2].abs().mean()


def test_odometry_adds_up_the_robots_own_motion_with_the_episodes_errors(device):
    """Beside dead reckoning in float64, from true poses and what the wrapper drew."""
    plain = envs.PointGoal(
        32, [toys.box()], robot=Robot(speed=2.0, accel=20.0), limit=12, device=device
    )
    env = OdometryDrift(plain, distance=0.1, turn=0.2, veer=0.3)
    world, agents = env.reset(), plain.core.agents
    generator, believed, before, n_apart = torch.Generator().manual_seed(1), None, None, 0
    bounds = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    for _ in range(40):
        place, angle = agents.positions[:, 0].cpu().double(), agents.angles[:, 0].cpu().double()
        if believed is None:
            believed = torch.cat([place, angle[:, None]], 1)
        else:
            moved, turned = place - before[0], (angle - before[1] + 180) % 360 - 180
            scale = (2 * env.draws.generator.values[:, :3].cpu().double() - 1) * bounds
            heading = believed[:, 2] + turned * (1 + scale[:, 1])
            heading += (scale[:, 2] * moved.norm(dim=1)).rad2deg()
            own = modules.to_global(heading - angle, moved) * (1 + scale[:, :1])
            believed = torch.cat([believed[:, :2] + own, heading[:, None]], 1)
            true = torch.cat([place, angle[:, None]], 1)
            believed = torch.where(world.reset.cpu()[:, None], true, believed)
        goals = plain.goals.points[plain.layout.long(), plain.goal_index.long()].cpu().double()
        relative = modules.to_local(believed[:, 2], goals - believed[:, :2])
        seen = world.obs.goal[:, 0].cpu().double()
        torch.testing.assert_close(10 * seen[:, :1] * seen[:, 1:], relative, atol=2e-2, rtol=0)
        n_apart += int(((believed[:, :2] - place).norm(dim=1) > 0.1).sum())
        before = place, angle
        actions = plain.movement.high.cpu() * (2 * torch.rand(32, 1, 2, generator=generator) - 0.5)
        world = env.step(arrdict(actions=actions.to(device)))
    assert n_apart > 20


def test_wrappers_of_robots_say_where_they_do_not_fit():
    with pytest.raises(ValueError, match=r"OdometryDrift: observations have no goal \(1, 3\)"):
        OdometryDrift(minimal())


def test_noisy_actions_are_uniform_or_nearly_gaussian_within_bounds():
    env = NoisyActions(Counting(4000), probability=0.4)
    env.reset()
    did = env.step(ones(env)).obs.did.flatten()
    rates = [(did == k).float().mean() for k in range(4)]
    assert rates == pytest.approx([0.1, 0.7, 0.1, 0.1], abs=0.02)

    class Steered(Counting):
        action_space = spaces.MultiContinuous(1, 1, low=-2.0, high=4.0)

        def step(self, decision):
            return self._resets.keep(
                self._world(self.ended.clone(), decision["actions"][..., 0, 0])
            )

    env = NoisyActions(Steered(4000), std=0.1)
    env.reset()
    did = env.step(arrdict(actions=torch.ones(4000, 1, 1))).obs.did.flatten()
    assert float(did.mean()) == pytest.approx(1, abs=0.02)
    assert float(did.std()) == pytest.approx(0.3, abs=0.02)
    did = env.step(arrdict(actions=torch.full((4000, 1, 1), 4.0))).obs.did
    assert float(did.max()) == 4


def test_frames_are_stacked_from_the_oldest_and_begin_anew_with_an_episode():
    env = FrameStack(Counting(2), n=3, sensors=("age",))
    assert env.obs_space["age"] == spaces.MultiVector(1, 3)
    rows = [env.reset().obs.age[0, 0].tolist()]
    rows += [env.step(ones(env)).obs.age[0, 0].tolist() for _ in range(7)]
    expected = [[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5], [0, 0, 0]]
    assert rows == [*expected, [0, 0, 1]]
    image = FrameStack(minimal(), n=2)
    assert image.obs_space.C == 6 and image.reset().obs.shape[-3] == 6


def test_a_time_limit_truncates_and_the_next_step_begins_an_episode():
    env = TimeLimit(Counting(3), n=3)
    world, ages, cuts = env.reset(), [], []
    for _ in range(8):
        world = env.step(ones(env))
        ages.append(int(world.obs.age[0, 0, 0]))
        cuts.append(bool(world.truncated[0]))
        assert bool(world.reset[0]) == (ages[-1] == 0) and not bool(world.terminal[0])
    assert ages == [1, 2, 3, 0, 1, 2, 3, 0]
    assert cuts == [False, False, True, False] * 2


def test_sensors_fail_and_are_noisy():
    env = DropSensor(Counting(4000), sensor="did", probability=0.3)
    env.reset()
    world = env.step(ones(env))
    assert float((world.obs.did == 0).float().mean()) == pytest.approx(0.3, abs=0.03)
    assert bool((world.obs.age == 1).all())
    env = NoisySensor(Counting(4000), sensor="did", std=0.5)
    env.reset()
    did = env.step(ones(env)).obs.did
    assert float(did.mean()) == pytest.approx(1, abs=0.03)
    assert float(did.std()) == pytest.approx(0.5, abs=0.03)


def test_rewards_are_scaled_clipped_and_shaped():
    env = ScaleReward(Counting(), factor={"from": 3.0, "to": 1.0})
    env.reset()
    assert env.step(ones(env)).reward[0] == 3
    (numbers,) = env.coefficients
    numbers.follow(0.5)
    assert env.step(ones(env)).reward[0] == 2
    env = ClipReward(Counting(), max=0.25)
    env.reset()
    assert env.step(ones(env)).reward[0] == 0.25
    env = ShapeReward(Counting(), function=lambda world: world.obs.age.flatten() + 10)
    assert env.reset().reward[0] == 0
    assert env.step(ones(env)).reward[0] == 11


@pytest.mark.parametrize(
    "word, message",
    [
        ("[frame_stak]", "'frame_stak' is not a wrapper; did you mean frame_stack?"),
        ("[time_limit]", "time_limit: n: is missing"),
        ("[{name:time_limit,n:0}]", "time_limit: n: 0 is out of range: allowed is at least 1"),
        ("[{name:frame_stack,m:3}]", "frame_stack has no setting 'm'; there are n, sensors"),
        ("[{name:drop_sensor,sensor:rgb}]", "there is no sensor 'rgb'; leave sensor out"),
        ("[{n:3}]", "a wrapper is a name or {name: ..., setting: ...}"),
        ("[os:getcwd]", "os:getcwd is no megastep.wrappers.Wrapper and cannot be used, as minimal"),
        ("[{name:clip_reward,min:1}]", "0 must be between min=1 and max=1"),
        ("[{name:scale_reward,factor:{from:1}}]", "scale_reward: factor: expected a number"),
    ],
)
def test_a_wrapper_that_does_not_fit_is_refused_in_one_sentence(word, message, here, capsys):
    words = [*TINY, f"env.wrappers={word}", "samples=64", "folder=run"]
    assert train.main(words) == 2
    assert message in capsys.readouterr().err
    assert not (here / "run").exists()


def test_wrong_spaces_and_environments_are_named():
    class Integers(Counting):
        obs_space = spaces.MultiDiscrete(1, 9)

    class Old(Counting):
        def reset(self):
            return super().reset()

    with pytest.raises(ValueError, match="obs is MultiDiscrete.*, and not MultiImage or MultiVec"):
        FrameStack(Integers())
    with pytest.raises(
        ValueError, match="env: int is not an Env: it has no n_envs, device, obs_sp"
    ):
        TimeLimit(3, n=3)
    with pytest.raises(
        ValueError, match="TimeLimit begins episodes .* needs reset.seed=None, mask"
    ):
        TimeLimit(Old(), n=3)

    class Masked(Counting):
        def _world(self, reset, did):
            mask = torch.ones(B, 1, 4, dtype=torch.bool)
            return arrdict(super()._world(reset, did), mask=mask)

    with pytest.raises(ValueError, match="StickyActions would take actions that .* mask forbids"):
        StickyActions(Masked()).reset()
    with pytest.raises(ValueError, match=r"must return rewards of shape \(64,\), not \(64, 1\)"):
        ShapeReward(Counting(), function=lambda world: world.reward[:, None]).reset()


def test_code_and_commands_of_the_page_work(here, monkeypatch):
    text = (pages.ROOT / "docs" / "wrappers.md").read_text()
    (code,) = pages.code(text)
    assert len([line for line in code.splitlines() if line]) <= 15
    (here / "my_wrappers.py").write_text(code)
    small = "env.n_envs=4", "agent.width=8", "samples=128", "device=cpu"
    with pages.inside(here, monkeypatch):
        for _, words in pages.commands(text):
            more = ("learner.n_minibatches=2",)
            more += () if "env=gymnasium" in words else ("geometry=box", "env.res=16")
            assert train.main([*words, *small, *more]) == 0, words
        from my_wrappers import PaidTurns

        plain, paid = (envs.explorer.Explorer(4, [toys.box()], device="cpu") for _ in range(2))
        paid = PaidTurns(paid, cost=0.25)
        plain.reset(), paid.reset()
        for action, cost in ((5, 0.25), (3, 0.0), (6, 0.25)):
            taken = arrdict(actions=torch.full((4, 1), action))
            difference = plain.step(taken).reward - paid.step(taken).reward
            torch.testing.assert_close(difference, torch.full((4,), cost))


class NoCopies(TorchDispatchMode):
    """Raises where a tensor is made of Python's numbers: on a GPU, a copy to the device, which a
    CUDA graph cannot hold.
    """

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        assert function is not torch.ops.aten.lift_fresh.default
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("words", [[], ["env.slide=true"], ["env.robot.sensor=rgb"]])
def test_a_step_of_the_robots_recipe_copies_nothing_to_the_device(words):
    """With all of its wrappers."""
    wrapped = tiny.settings("experiment=robot", "geometry.n=2", "env.n_envs=4", *words).env
    if words[-1:] == ["env.robot.sensor=rgb"]:
        wrapped = settings.changed(wrapped, wrappers=wrapped.wrappers[:3])
    env = make.make_sample(wrapped, sample("homes", 2), seed=1, device="cpu")
    assert isinstance(env, Wrapper)
    world = env.reset()
    decision = arrdict(actions=contract.random_actions(env, torch.Generator().manual_seed(1)))
    for _ in range(3):
        with NoCopies():
            world = env.step(decision)
    assert world.obs.goal.isfinite().all()
