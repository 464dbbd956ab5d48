"""Values that an environment's spaces or interface do not allow are named at the first steps."""

import re

import numpy as np
import pytest
import torch

from megastep import contract
from megastep.arrdict import arrdict

gymnasium = pytest.importorskip("gymnasium")
from gymnasium import spaces  # noqa: E402

from megastep.envs import Gymnasium  # noqa: E402
from megastep.hosting.env_error import BadValue  # noqa: E402
from megastep.hosting.hosted import HostedEnvs  # noqa: E402
from megastep.hosting.values import beyond_bounds, problem  # noqa: E402
from tests.helpers.odd_envs import Odd  # noqa: E402


class Wrong(Odd):
    """Gives one wrong thing."""

    def __init__(self, what):
        self.what = what
        super().__init__()

    def reset(self, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        return {"reset with one": obs, "reset info": (obs, None)}.get(self.what, (obs, info))

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return {
            "four": (obs, reward, terminated, info),
            "shape": (np.zeros((2, 1), np.float32), reward, terminated, truncated, info),
            "info": (obs, reward, terminated, truncated, None),
            "reward": (obs, None, terminated, truncated, info),
            "flag": (obs, reward, None, truncated, info),
        }.get(self.what, (obs, reward, terminated, truncated, info))


@pytest.mark.parametrize(
    "what, problem",
    [
        ("reset with one", "reset() must return (observation, info), and returned"),
        ("reset info", "reset() must return a dict as info, and returned None"),
        ("four", "step() must return (observation, reward, terminated, truncated, info), and ret"),
        ("shape", "step() returned an observation that is not in its space, Box(0.0, 1e+06, (1,)"),
        ("info", "step() must return a dict as info, and returned None"),
        ("reward", "step() must return a number as reward, and returned None"),
        ("flag", "step() must return a bool as terminated, and returned None"),
    ],
)
def test_wrong_results_are_named(what, problem):
    envs = HostedEnvs(lambda: Wrong(what), 2)
    with pytest.raises(BadValue, match=f"^environment 0: {re.escape(problem)}") as error:
        envs.reset(seed=[1, 2])
        envs.step(np.zeros(2, int))
    assert str(error.value).endswith("To leave it as it is, use env.check=false")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "space, value, is_wrong",
    [
        (spaces.Discrete(4), np.int64(3), False),
        (spaces.Discrete(4), 1.5, True),
        (spaces.Box(0, 1, (3,)), np.zeros(1), True),
        (spaces.Box(0, 1, (2,)), [[1], [1, 2]], True),
        (spaces.Box(0, 1, (3,)), np.full(3, 5.0), False),  # beyond its bounds, in float64
        (spaces.Dict(a=spaces.Discrete(2)), {"b": 1}, True),
        (spaces.Tuple([spaces.Discrete(2)] * 2), (1,), True),
    ],
)
def test_observations_of_another_form_than_their_space(space, value, is_wrong):
    found = problem("reset", (value, {}), space)
    assert (found is not None) == is_wrong
    assert not found or found.startswith("reset() returned an observation that is not in its space")


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


class Far(Odd):
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
