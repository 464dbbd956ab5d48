"""Gymnasium's environments keep the contract, in this process and in others."""

import copy
import os
import re
import signal
import sys
import warnings

import numpy as np
import pytest
import torch

from megastep import contract
from megastep.arrdict import arrdict
from megastep.env_state import EnvState, way_back
from megastep.envs import Gymnasium
from megastep.hosting.env_error import EnvError

gymnasium = pytest.importorskip("gymnasium")
VECTORIZATIONS = "sync", "async"


class Counter(gymnasium.Env):
    """Observes and earns the number of steps. After `limit` of them, it ends as `ends` says."""

    observation_space = gymnasium.spaces.Box(0, 100, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, limit=3, ends=(True, False)):
        self.limit, self.ends = limit, ends

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        ends = self.ends if self.count == self.limit else (False, False)
        return np.full(1, self.count, np.float32), float(self.count), *ends, {"info": object()}


class Unbounded(Counter):
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))


class Reader(Counter):
    observation_space = gymnasium.spaces.Dict(
        a=gymnasium.spaces.Box(0, 1), b=gymnasium.spaces.Tuple([gymnasium.spaces.Text(3)])
    )


@pytest.fixture(autouse=True, scope="module")
def registered():
    for cls in (Counter, Unbounded, Reader):
        gymnasium.register(f"Test{cls.__name__}-v0", cls, disable_env_checker=True)
    yield
    for name in [name for name in gymnasium.registry if name.startswith("Test")]:
        del gymnasium.registry[name]


def cart_pole(n_envs=4, **settings):
    return Gymnasium(n_envs, id="CartPole-v1", **{"device": "cpu", **settings})


def do_nothing(env):
    return arrdict(actions=torch.zeros(env.n_envs, 1, dtype=torch.int64))


# ---- The contract ----


@pytest.mark.parametrize("vectorization", VECTORIZATIONS)
def test_contract(vectorization):
    env = cart_pole(6, vectorization=vectorization)
    worlds = contract.rollout(env, 60)
    env.close()
    assert sum(int(world.terminal.sum()) for world in worlds) >= 6
    assert worlds[0].obs.dtype == torch.float32 and worlds[0].obs.shape == (6, 1, 4)


@pytest.mark.parametrize("ends, flag", [((True, False), "terminal"), ((False, True), "truncated")])
def test_episode_ends_with_its_true_last_observation(ends, flag):
    env = Gymnasium(2, id="TestCounter-v0", kwargs={"limit": 2, "ends": ends}, device="cpu")
    worlds = contract.rollout(env, 5)
    for key, expected in {
        "obs": [0, 1, 2, 0, 1, 2],
        "reward": [0, 1, 2, 0, 1, 2],
        "reset": [1, 0, 0, 1, 0, 0],
        "terminal": [0, 0, flag == "terminal", 0, 0, flag == "terminal"],
        "truncated": [0, 0, flag == "truncated", 0, 0, flag == "truncated"],
    }.items():
        values = torch.stack([world[key].float().flatten() for world in worlds])
        assert values[:, 1].tolist() == expected, key


def test_each_environment_has_its_own_seed():
    first, again, other = (cart_pole(seed=seed).reset().obs for seed in (1, 1, 2))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert len({tuple(row) for row in torch.cat([first, other]).flatten(1).tolist()}) == 8
    env = cart_pole()
    assert not torch.equal(env.reset().obs, env.reset().obs), "a second reset begins other episodes"


# ---- Processes ----


def test_processes_compute_the_bits_of_one():
    worlds = [contract.rollout(cart_pole(5, vectorization=kind), 30) for kind in ("sync", "async")]
    assert all(map(contract.same, *worlds))


def processes_of(env):
    """Returns the ids of the processes that step an environment."""
    return [process.pid for process in env.vector.processes]


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_processes_ignore_ctrl_c_and_end_with_the_environment():
    env = cart_pole(vectorization="async")
    env.reset()
    pids = processes_of(env)
    for pid in pids:
        os.kill(pid, signal.SIGINT)
    env.step(do_nothing(env))
    assert all(map(is_running, pids))
    env.close()
    env.close()
    assert pids and not any(map(is_running, pids))


def test_killed_process_is_named_and_the_others_end():
    env = cart_pole(vectorization="async")
    env.reset()
    pids = processes_of(env)
    os.kill(pids[0], signal.SIGKILL)
    with pytest.raises(MemoryError, match="a process that steps environments was killed"):
        for _ in range(2):
            env.step(do_nothing(env))
    del env
    assert not any(map(is_running, pids))


@pytest.mark.parametrize("vectorization", VECTORIZATIONS)
def test_error_of_an_environment_is_named_with_its_traceback(vectorization):
    env = cart_pole(vectorization=vectorization)
    env.reset()
    with pytest.raises(
        EnvError, match="^CartPole-v1: environment 0 failed: AssertionError: .*invalid"
    ) as error:
        env.step(arrdict(actions=torch.full((4, 1), 7)))
    assert "cartpole.py" in error.value.trace and "hosting" not in error.value.trace
    env.close()


# ---- On a GPU ----


@pytest.mark.cuda
def test_gpu_learner_gets_the_same_worlds_and_no_graph():
    from megastep.agents.algorithms.ppo import PPO
    from megastep.agents.networks.policy import Policy

    worlds = [contract.rollout(cart_pole(device=device), 30) for device in ("cpu", "cuda")]
    assert all(map(contract.same, *worlds))
    env = cart_pole(device="cuda")
    policy = Policy(env.obs_space, env.action_space, width=16).to(env.device)
    learner = PPO(policy, n_steps=8, n_minibatches=2, graph=True)
    collect = learner.collector(env)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(4):
            learner.update(collect())
    assert collect.graph is None


# ---- Drawing and resuming ----


def test_frames_are_those_of_the_environment(monkeypatch):
    """And pygame, which draws them, does not look for a display where there is none."""
    pytest.importorskip("pygame")
    for name in "DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER":
        monkeypatch.setenv(name, "")  # restored after the test
        monkeypatch.delenv(name)
    env = cart_pole(2)
    env.reset()
    assert env.vector.render_mode is None  # which would slow some environments
    frames = [env.plot_state(env.state(e)) for e in range(2)]
    assert frames[0].shape == (400, 600, 3) and frames[0].dtype == torch.uint8
    assert not torch.equal(*frames) and env.fps == 50
    assert sys.platform != "linux" or os.environ["SDL_VIDEODRIVER"] == "dummy"


def test_environment_that_draws_nothing_says_so():
    env = Gymnasium(1, id="TestCounter-v0", device="cpu")
    env.reset()
    with pytest.raises(ValueError, match="TestCounter-v0 renders no images: it has no render mode"):
        env.state(0)


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
def test_state_is_restored_exactly(name):
    """Into another object that began with the same seeds, as a resumed run does. Frozen Lake holds
    an array of characters.
    """
    env, resumed = (Gymnasium(4, id=name, device="cpu") for _ in range(2))
    assert env.resumable
    env.reset(), resumed.reset()
    state, state_of_resumed = EnvState(env), EnvState(resumed)
    contract.rollout(env, 20)
    saved = copy.deepcopy(state.state_dict())
    generator = torch.Generator().manual_seed(1)
    actions = [arrdict(actions=contract.random_actions(env, generator)) for _ in range(40)]
    expected = [env.step(one) for one in actions]
    state_of_resumed.load_state_dict(saved)
    worlds = [resumed.step(one) for one in actions]
    assert all(map(contract.same, worlds, expected))
    assert any(world.reset.any() for world in worlds)


def test_goes_back_to_before_its_first_reset():
    env = cart_pole()
    assert env.max_episode_steps == 500
    go_back = way_back(env)
    worlds = contract.rollout(env, 30)
    go_back()
    assert all(map(contract.same, contract.rollout(env, 30), worlds))


def test_resumable_if_all_state_is_in_python():
    assert cart_pole().resumable
    env = cart_pole(vectorization="async")
    assert not env.resumable
    env.close()


# ---- Bad input ----


@pytest.mark.parametrize(
    "settings, message",
    [
        ({}, "^env.id is missing; name an environment, such as env.id=CartPole-v1$"),
        ({"id": "CartPol-v1"}, "no environment 'CartPol-v1'; did you mean CartPole-v1?"),
        ({"id": "xyz"}, r"^Gymnasium has no environment 'xyz'\. Those of other packages are"),
        ({"id": "no_such_package:A-v0"}, "needs the package no_such_package, which cannot be"),
        (
            {"id": "CartPole-v1", "kwargs": {"mass": 3}},
            r"^CartPole-v1 cannot be made with env.kwargs={'mass': 3}: .*unexpected .* 'mass'$",
        ),
        ({"id": "CartPole-v1", "wrappers": ("nowhere:A",)}, "^env.wrappers: nowhere:A cannot be"),
        (
            {"id": "TestUnbounded-v0"},
            "^TestUnbounded-v0: action is Box.*, and actions need finite bounds.*env.wrappers=",
        ),
        (
            {"id": "TestReader-v0"},
            r"^TestReader-v0: observation\['b'\]\[0\] is a Text.*, which no encoder takes; give it",
        ),
        ({"id": "CartPole-v1", "vectorization": "many"}, "^vectorization: 'many' is unknown"),
    ],
)
def test_bad_settings_are_one_sentence(settings, message):
    with pytest.raises(ValueError, match=message) as error:
        Gymnasium(2, device="cpu", **settings)
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_gymnasium_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gymnasium", None)
    with pytest.raises(ValueError, match=re.escape("pip install 'megastep-flatland[gymnasium]'")):
        cart_pole()
