"""Environments of other packages that fail, end their process, or render oddly."""

import re
import warnings

import numpy as np
import pytest
import torch

from megastep import contract
from megastep.arrdict import arrdict
from megastep.env_state import EnvState

gymnasium = pytest.importorskip("gymnasium")
from megastep.envs import Gymnasium  # noqa: E402
from megastep.hosting.env_error import EnvError  # noqa: E402
from megastep.hosting.guard import HostedEnvs  # noqa: E402
from megastep.hosting.probe import probe  # noqa: E402
from megastep.hosting.vectorized import _as_frame as as_frame  # noqa: E402
from tests.helpers import odd_envs  # noqa: E402


def make(name, n_envs=4, **settings):
    name = f"tests.helpers.odd_envs:Odd{name}-v0"
    return Gymnasium(n_envs, id=name, **{"device": "cpu", **settings})


def act(env):
    return env.step(arrdict(actions=torch.zeros(env.n_envs, 1, dtype=torch.int64)))


class FailsAt(odd_envs.Odd):
    """Fails in its third step."""

    def step(self, action):
        if self.count == 2:
            raise ValueError("no")
        return super().step(action)


def test_failed_environment_is_made_anew_and_its_episode_truncated():
    vector = HostedEnvs(FailsAt, 1, restart_failed=2)
    vector.reset(seed=[5])
    first, n_failures = vector.envs[0].env, 0
    for expected in [(1, 1), (2, 1), (2, 0), (0, 0), (1, 1), (2, 1), (2, 0), (0, 0), (1, 1)]:
        obs, reward, terminated, truncated, infos = vector.step(np.zeros(1, int))
        assert (obs.item(), reward.item()) == expected and not terminated
        assert truncated == (expected == (2, 0)) == ("failure" in infos)
        n_failures += int(infos.get("restarts", np.zeros(1)).sum())
    assert n_failures == 2 and vector.envs[0].env is not first
    vector.step(np.zeros(1, int))
    with pytest.raises(EnvError, match="^environment 0 failed: ValueError: no$") as error:
        vector.step(np.zeros(1, int))
    assert "odd" not in error.value.trace and "in step" in error.value.trace


def test_failed_environments_are_counted_the_same_in_processes():
    worlds, counts = [], []
    for vectorization in ("sync", "async"):
        env = make("Crash", 5, vectorization=vectorization, restart_failed=9)
        with pytest.warns(
            UserWarning, match="OSError: simulator does not answer; it was made anew"
        ):
            worlds.append(contract.rollout(env, 40))
        counts.append((env.pop_restarts(), env.pop_restarts()))
        env.close()
    assert all(map(contract.same, *worlds)) and counts[0] == counts[1]
    lengths = sum(int(world.truncated.sum()) for world in worlds[0])
    assert lengths > counts[0][0] > 0 == counts[0][1]


def test_count_of_failures_is_in_the_state():
    env, resumed = (make("Crash", restart_failed=9) for _ in range(2))
    env.reset(), resumed.reset()
    state, of_resumed = EnvState(env), EnvState(resumed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(60):
            act(env)
        of_resumed.load_state_dict(state.state_dict())
        worlds = [(act(env), act(resumed)) for _ in range(60)]
    assert all(contract.same(*pair) for pair in worlds)
    assert env.pop_restarts() == resumed.pop_restarts() > 0


def test_process_that_ends_is_named_with_its_environments():
    env = make("Exits", 2, vectorization="async")
    env.reset()
    text = "the process that steps environments 0 to .* was ended with exit code 7"
    with pytest.raises(EnvError, match=text):
        for _ in range(20):
            act(env)


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_environment_that_cannot_be_closed(vectorization):
    env = make("CloseFails", 2, vectorization=vectorization)
    env.reset()
    with pytest.raises(EnvError, match="failed: RuntimeError: viewer already gone"):
        env.close()


# ---- Numbers of the last info ----


def test_numbers_of_the_last_info_are_metrics():
    names = {"is_success": 1.0, "x": 10.0, "a_b": 2.0, "return_": 5.0}
    for vectorization in ("sync", "async"):
        env = make("Scores", 3, vectorization=vectorization)
        worlds = contract.rollout(env, 20)
        env.close()
        assert [*worlds[0].metrics] == [*names]
        ends = worlds[10].metrics
        assert {name: value.tolist() for name, value in ends.items()} == {
            name: 3 * [value] for name, value in names.items()
        }


def test_at_most_16_numbers_and_is_success_first():
    with pytest.warns(UserWarning, match="has 19 numbers; 16 become metrics, and n15, n16, n17 do"):
        env = make("ManyScores")
    assert [*env.reset().metrics] == ["is_success", *(f"n{i}" for i in range(15))]


def test_the_try_leaves_global_generators_alone():
    class Draws(odd_envs.Odd):
        def reset(self, seed=None, options=None):
            np.random.random(), torch.rand(1)
            return super().reset(seed=seed)

    np.random.seed(1), torch.manual_seed(1)
    expected = np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()
    assert probe(Draws).generators == ("numpy", "torch")
    assert (np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()) == expected


# ---- Frames ----


@pytest.mark.parametrize(
    "rendered, expected",
    [
        (np.full((2, 3, 3), 7, np.uint8), 7),
        (np.full((2, 3), 7, np.uint8), 7),
        (np.full((2, 3, 1), 7, np.int64), 7),
        (np.full((2, 3, 4), 7, np.uint8), 7),
        (np.full((2, 3, 3), 128.0), 128),
        (np.full((2, 3, 3), 0.5), 128),
        (np.full((2, 3, 3), 1.0), 255),
        (np.full((2, 3, 3), 255.0), 255),
    ],
)
def test_frames(rendered, expected):
    frame = as_frame(rendered)
    assert frame.shape == (2, 3, 3) and frame.dtype == np.uint8
    assert (frame == expected).all()


@pytest.mark.parametrize(
    "rendered, text",
    [
        (None, "render() returned None, not an image"),
        ("a frame", "render() returned <U7 of shape ()"),
        (np.zeros((2, 3, 2)), "float64 of shape (2, 3, 2)"),
        (np.full((2, 3, 3), 300.0), "numbers from 300 to 300"),
        (np.full((2, 3, 3), -3), "numbers from -3 to -3"),
    ],
)
def test_frames_that_are_no_images_are_named(rendered, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        as_frame(rendered)


def test_renderer_is_made_when_filming_alone():
    env = make("BuildsRenderer", 1, films=True)
    env.reset()
    assert (env.state(0).frame == 9).all()
    env = make("BuildsRenderer", 1)
    env.reset()
    with pytest.raises(ValueError, match="render\\(\\) returned None"):
        env.state(0)
