"""Environments of other packages that fail, end their process, or render oddly."""

import re

import numpy as np
import pytest
import torch

from megastep import contract
from megastep.arrdict import arrdict

gymnasium = pytest.importorskip("gymnasium")
from megastep.envs import Gymnasium  # noqa: E402
from megastep.hosting.env_error import EnvError  # noqa: E402
from megastep.hosting.probe import probe  # noqa: E402
from megastep.hosting.vectorized import as_frame  # noqa: E402
from tests.helpers import odd_envs  # noqa: E402


def make(name, n_envs=4, **settings):
    name = f"tests.helpers.odd_envs:Odd{name}-v0"
    return Gymnasium(n_envs, id=name, **{"device": "cpu", **settings})


def act(env):
    return env.step(arrdict(actions=torch.zeros(env.n_envs, 1, dtype=torch.int64)))


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
        (np.full((2, 3, 4), 7, np.uint8), 7),
        (np.full((2, 3, 3), 128.0), 128),
        (np.full((2, 3, 3), 0.5), 128),
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
