"""Privileged observations in rollouts and updates."""

import math

import pytest
import torch

from megastep import spaces
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.collector import collect, initial_actor_state
from megastep.agents.storage.rollout import Rollout
from megastep.arrdict import arrdict

T, B, WIDTH = 8, 6, 16
OBS, MOVES = arrdict(eye=spaces.MultiVector(1, 4)), spaces.MultiDiscrete(1, 3)
PRIVILEGED = arrdict(episode=spaces.MultiVector(1, 2), unseen=spaces.MultiVector(1, 5))


def policy_of(critic="asymmetric"):
    """Returns a policy far from uniform."""
    policy = Policy(OBS, MOVES, PRIVILEGED, width=WIDTH, critic=critic, seed=0)
    with torch.no_grad():
        policy.output.linear.weight.mul_(100)
    return policy


class PrivilegedEnv:
    """Observations are 0. Privileged observations are 100 b + t + 1/512 in lane b at time t, which
    float16 cannot represent. An episode lasts three steps.
    """

    obs_space, action_space, privileged_space = OBS, MOVES, PRIVILEGED

    def __init__(self, device="cpu"):
        self.device = device
        self.time = torch.zeros((), dtype=torch.int64, device=device)
        self.lanes = 100.0 * torch.arange(B, device=device)

    def reset(self):
        return self._world()

    def step(self, decision):
        self.time += 1
        return self._world()

    def _world(self):
        none = torch.zeros(B, dtype=torch.bool, device=self.device)
        label = (self.lanes + self.time + 1 / 512).view(B, 1, 1)
        return arrdict(
            obs=arrdict(eye=torch.zeros(B, 1, 4, device=self.device)),
            privileged=arrdict(episode=label.expand(B, 1, 2), unseen=label.expand(B, 1, 5)),
            reward=label.flatten() / 100,
            reset=none | (self.time % 4 == 0),
            terminal=none | (self.time % 4 == 3),
            truncated=none,
        )


def rollout_of(policy, device="cpu"):
    return Rollout(T, B, OBS, MOVES, policy.initial(B), device, policy.privileged_space)


def test_rollout_stores_privileged_as_float32():
    env, policy = PrivilegedEnv(), policy_of()
    rollout = rollout_of(policy)
    actor_state = initial_actor_state(env, policy, rollout)
    for _ in range(2):
        actor_state = collect(env, policy, rollout, actor_state)
    lanes, times = 100.0 * torch.arange(B), T + torch.arange(T + 1)
    expected = lanes + times[:, None] + 1 / 512
    for values in rollout.privileged.values():
        assert values.dtype == torch.float32
        assert torch.equal(values[:, :, 0, 0], expected)
    rows = torch.tensor([4, 1])
    assert torch.equal(rollout.sequences(rows).privileged.unseen[..., 0, 4], expected[:, rows])
    out = policy.unroll(rollout.obs, rollout.starts, rollout.state)
    # sums of numbers up to 600 in another order
    expected = policy.value(out.features, rollout.privileged)
    torch.testing.assert_close(rollout.values, expected, rtol=1e-4, atol=1e-4)


def test_plain_critic_stores_no_privileged():
    env, policy = PrivilegedEnv(), policy_of("plain")
    rollout = rollout_of(policy)
    collect(env, policy, rollout, initial_actor_state(env, policy, rollout))
    assert rollout.privileged is None and "privileged" not in rollout.sequences(torch.tensor([0]))
    assert not any("privileged" in name for name in rollout.floats())


def collected(critic="asymmetric"):
    """Returns a policy and a rollout that it collected."""
    env, policy = PrivilegedEnv(), policy_of(critic)
    rollout = rollout_of(policy)
    collect(env, policy, rollout, initial_actor_state(env, policy, rollout))
    return policy, rollout


def test_update_normalises_privileged():
    policy, rollout = collected()
    metrics = PPO(policy).update(rollout)
    assert metrics["loss/auxiliary"] > 0
    for norm, values in zip(policy.critic.intake.norms, rollout.privileged.values(), strict=True):
        torch.testing.assert_close(norm.mean, values[-1].mean(0))


@pytest.mark.parametrize("critic, coef", [("asymmetric", 0.0), ("plain", 0.5)])
def test_prediction_unchanged_without_auxiliary_loss(critic, coef):
    policy, rollout = collected(critic)
    before = {name: weight.clone() for name, weight in policy.state_dict().items()}
    metrics = PPO(policy, auxiliary_coef=coef).update(rollout)
    after = policy.state_dict()
    assert all(torch.equal(after[k], before[k]) for k in after if k.startswith("prediction"))
    assert not torch.equal(after["core.recurrent.weight"], before["core.recurrent.weight"])
    assert ("loss/auxiliary" in metrics) == (critic == "asymmetric")


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
def test_nonfinite_privileged_skips_update(value):
    policy, rollout = collected()
    learner = PPO(policy, n_minibatches=B)
    before = {name: weight.clone() for name, weight in policy.state_dict().items()}
    rollout.privileged.episode[2, 3, 0, 1] = value
    learner.update(rollout)
    after = policy.state_dict()
    assert all(torch.equal(after[name], before[name]) for name in before)
    bad, n_skipped = learner.check.read(rollout.floats())
    assert (bad.name, bad.lane, bad.step) == ("privileged.episode", 3, 2) and n_skipped == 1
    assert bad.is_from_env
