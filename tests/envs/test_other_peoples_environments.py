"""Environments of other packages that fail, end their process, render oddly, or give values that
their spaces or Gymnasium's interface do not allow.
"""

import random

import numpy as np
import pytest
import torch

from megastep import contract
from megastep.arrdict import arrdict

gymnasium = pytest.importorskip("gymnasium")
from gymnasium import spaces  # noqa: E402

from megastep.envs import Gymnasium  # noqa: E402
from megastep.global_generators import GlobalGenerators  # noqa: E402
from megastep.hosting.env_error import BadValue, EnvError  # noqa: E402
from megastep.hosting.hosted import HostedEnvs  # noqa: E402
from megastep.hosting.probe import beyond_bounds, probe  # noqa: E402
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


def test_global_generators_do_not_draw_what_environments_draw():
    """NumPy takes [seed, 0] for the seed, which those of environments come from."""
    seeds = np.random.SeedSequence(3).generate_state(2).tolist()
    generators = GlobalGenerators([3, 0])
    assert generators.python.random() != random.Random(seeds[0]).random()
    assert generators.torch_seed != seeds[1]


# ---- Frames ----


def test_renderer_is_made_when_filming_alone():
    env = make("BuildsRenderer", 1, films=True)
    env.reset()
    assert (env.state(0).frame == 9).all()
    env = make("BuildsRenderer", 1)
    env.reset()
    with pytest.raises(ValueError, match="a frame must have shape .H, W, 3., but this one has"):
        env.state(0)


# ---- Wrong values ----


class Wrong(odd_envs.Odd):
    """Gives one wrong thing."""

    def __init__(self, what):
        self.what = what
        super().__init__()

    def reset(self, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        return obs if self.what == "reset with one" else (obs, info)

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        rest = (info,) if self.what == "four" else (truncated, info)
        return obs, reward, terminated, *rest


@pytest.mark.parametrize("what", ["reset with one", "four"])
def test_wrong_results_are_named(what):
    envs = HostedEnvs(lambda: Wrong(what), 2)
    text = "^environment 0 failed: ValueError: not enough values to unpack"
    with pytest.raises(EnvError, match=text) as error:
        envs.reset(seed=[1, 2])
        envs.step(np.zeros(2, int))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "space, batch, text",
    [
        (spaces.Box(0, 1, (2,)), [[0, 1], [0.5, 1.00001]], None),  # a rounding error
        (spaces.Box(0, 1, (2,)), [[0, 1], [0.5, 1.1]], "it has 1.1 in lane 1, and the space is Bo"),
        (spaces.Box(-np.inf, 1, (1,)), [[np.nan], [-1e30]], None),
        (spaces.Discrete(3, start=1), [1, 3], None),
        (spaces.Discrete(3), [0, 3], "it has 3 in lane 1, and the space is Discrete(3)"),
        (spaces.Dict(a=spaces.Discrete(2)), {"a": [2]}, "its part 'a' has 2 in lane 0"),
    ],
)
def test_batches_beyond_bounds(space, batch, text):
    arrays = {key: np.array(part) for key, part in batch.items()} if "a" in batch else None
    found = [*beyond_bounds(space, arrays or np.array(batch))]
    assert (not found) == (text is None) and len(found) < 2
    for clause, is_box in found:
        assert clause.startswith(text) and is_box == isinstance(space, spaces.Box)


class Far(odd_envs.Odd):
    """Observes up to 10, where 5 is the bound."""

    observation_space = spaces.Box(0, 5, (1,))


gymnasium.register("Far-v0", Far)


def test_numbers_beyond_a_box_are_a_warning():
    env = Gymnasium(2, id=f"{__name__}:Far-v0", device="cpu")
    with pytest.warns(
        UserWarning, match="Far-v0: .*it has 6.0 in lane 0.* It is used as it is"
    ) as w:
        worlds = contract.rollout(env, 25)
    assert len(w) == 1 and w[0].filename == contract.__file__, "the line that steps"
    assert worlds[10].obs.tolist() == [[[10.0]], [[10.0]]]


def test_actions_that_are_not_finite_are_named():
    decision = arrdict(actions=torch.tensor([[[0.0]], [[torch.nan]]]))
    env = Gymnasium(2, id="Pendulum-v1", device="cpu")
    env.reset()
    with pytest.raises(BadValue, match="Pendulum-v1: the action for lane 1 is not finite, so the"):
        env.step(decision)
