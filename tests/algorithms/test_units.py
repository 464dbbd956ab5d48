"""Learning does not depend on the units of observations and rewards."""

import functools

import pytest
import torch

from megastep import spaces
from megastep.agents.networks.running_norm import UNKNOWN_SCALE
from megastep.arrdict import arrdict
from megastep.envs import Pong
from tests.helpers.learners import LEARNERS

STATISTICS = ("mean", "scale")
#: Powers of two, which change no bit of a mantissa: about 1e-6 and 1e6, 1e-5 and 1e5.
OBS, REWARDS = (2.0**-20, 2.0**20), (2.0**-17, 2.0**17)


class InUnits:
    """Pong with observations and rewards in other units. The last number observed is constant."""

    def __init__(self, obs=1.0, reward=1.0):
        self.env, self.factors = Pong(8, device="cpu", limit=40), (obs, reward)
        self.n_envs, self.device, self.action_space = 8, self.env.device, self.env.action_space
        self.obs_space = spaces.MultiVector(1, 9, dtype=torch.float32)

    def reset(self):
        return self.in_units(self.env.reset())

    def step(self, decision):
        return self.in_units(self.env.step(decision))

    def in_units(self, world):
        obs, reward = self.factors
        values = torch.cat([world.obs.float(), torch.ones(8, 1, 1)], -1) * obs
        return arrdict(world, obs=values, reward=world.reward * reward)


@functools.cache
def learnt(kind, n_updates=4, **units):
    """Returns the weights after some updates, without statistics, and the metrics."""
    torch.manual_seed(0)
    policy, learner = LEARNERS[kind].make(InUnits(**units), width=8)
    collect = learner.collector(InUnits(**units))
    for _ in range(n_updates):
        metrics = learner.update(collect())
    assert policy.intake.norms[0].scale[0, -1] == UNKNOWN_SCALE
    weights = policy.state_dict().items()
    weights = {k: v for k, v in weights if k.rpartition(".")[2] not in STATISTICS}
    return weights, {name: value.item() for name, value in metrics.items()}


@pytest.mark.parametrize("kind", ["ppo", "vtrace", "r2d2"])
@pytest.mark.parametrize(
    "units",
    [*({"obs": factor} for factor in OBS), *({"reward": factor} for factor in REWARDS)],
    ids=str,
)
def test_other_units_change_no_bit(kind, units):
    if kind == "r2d2" and "reward" in units:
        pytest.skip("its value rescaling has a unit")
    weights, metrics = learnt(kind)
    others, other_metrics = learnt(kind, **units)
    assert metrics["loss/skipped_steps"] == 0
    assert all(torch.equal(weights[name], others[name]) for name in weights)
    assert metrics == pytest.approx(other_metrics, nan_ok=True)


@pytest.mark.parametrize("factor", [1e-5, 1e5])
def test_r2d2_divides_rewards_of_an_unusual_size(factor):
    """By their root mean square in the first rollout with any."""
    policy, learner = LEARNERS["r2d2"].make(InUnits(reward=factor), width=8)
    collect, expected = learner.collector(InUnits(reward=factor)), 0
    for _ in range(4):
        rollout = collect()
        learner.update(rollout)
        size = rollout.reward[~rollout.reset].square().mean().sqrt().item()
        expected = expected or size
    assert learner.reward_scale.item() == pytest.approx(expected, rel=1e-5) and expected > 0
    learner.load_state_dict(learner.state_dict())
    assert learner.reward_scale.item() == pytest.approx(expected, rel=1e-5)
