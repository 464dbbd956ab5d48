"""Minibatches of fresh and replayed sequences. Every number encodes its lane and time."""

import pytest
import torch

from megastep import spaces
from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import ReplayBuffer, ReplaySettings
from megastep.agents.storage.rollout import Rollout

T, B = 4, 3
OBS, MOVES = spaces.MultiVector(1, 2), spaces.MultiDiscrete(1, 60)
PRIVILEGED = spaces.MultiVector(1, 1)
LANES = torch.tensor([2, 0])


def rollouts(policy, n):
    """Yields consecutive rollouts in which every number is 10 t + b at time t of lane b."""
    for i in range(n):
        rollout = Rollout(T, B, OBS, MOVES, policy.initial(B), privileged_space=PRIVILEGED)
        times = torch.arange(i * T, (i + 1) * T + 1)
        label = 10 * times[:, None] + torch.arange(B)
        rollout.obs[:] = label[..., None, None]
        rollout.privileged[:] = label[..., None, None]
        rollout.actions[:] = label[:-1, :, None]
        rollout.logprobs[:] = rollout.reward[:] = label[:-1]
        rollout.state.cell[:] = rollout.state.output[:] = label[0, :, None] / 100
        yield rollout


def batch_of(n_rollouts, n=5, burn_in=0, **settings):
    policy = Policy(OBS, MOVES, PRIVILEGED, width=8)
    ratio = n / len(LANES)
    settings = ReplaySettings(capacity=4 * T * B, burn_in=burn_in, ratio=ratio, **settings)
    learner = VTrace(policy, buffer="replay", replay=settings)
    for i, rollout in enumerate(rollouts(policy, n_rollouts)):
        if i == 0:
            learner.replay_buffer = ReplayBuffer(rollout, settings)
        learner.replay_buffer.add(rollout)
    return policy, learner.replay_buffer, rollout, learner._batch(rollout, LANES)


@pytest.mark.parametrize("burn_in", [0, 2])
def test_fresh_and_replayed_rows_line_up(burn_in):
    _, _, rollout, batch = batch_of(4, burn_in=burn_in)
    label = batch.obs[..., 0, 0]
    assert label.shape == (T + 1, 2 + 5)
    assert torch.equal(label[:, :2], rollout.obs[:, LANES, 0, 0])
    assert torch.equal(label[1:] - label[:-1], torch.full((T, 7), 10.0, dtype=label.dtype))
    # a sequence starts where a rollout starts, and its batch after the burn-in
    assert ((label[0] // 10) % T == torch.tensor([0, 0, *[burn_in % T] * 5])).all()
    assert torch.equal(batch.privileged[..., 0, 0], label.float())
    assert torch.equal(batch.actions[..., 0], label[:-1].long())
    assert torch.equal(batch.reward, label[:-1].float())
    assert torch.equal(batch.logprobs, label[:-1].float())
    assert batch.learns.all() and batch.weight.shape == batch.age.shape == (7,)
    assert not batch.age[:2].any() and (batch.age[2:] >= 1).all() and batch.index.shape == (5,)
    if not burn_in:
        torch.testing.assert_close(
            batch.state.cell[:, 0], label[0].float() / 100, rtol=1e-3, atol=0
        )


def test_burn_in_warms_up_hidden_state():
    policy, _, _, batch = batch_of(4, burn_in=2)
    for i in range(2, 7):
        first = batch.obs[0, i, 0, 0] - 20  # the rollout started two steps earlier
        obs = torch.stack([first, first + 10]).half().view(2, 1, 1, 1).expand(2, 1, 1, 2)
        state = policy.initial(1).map(lambda leaf, x=first: torch.full_like(leaf, float(x) / 100))
        after = policy.unroll(obs, torch.zeros(2, 1, dtype=torch.bool), state).state
        # the hidden state is stored as float16
        torch.testing.assert_close(batch.state.cell[i], after.cell[0], rtol=1e-2, atol=1e-3)


def test_replayed_do_not_learn_until_ready():
    *_, batch = batch_of(1)
    assert batch.learns[:, :2].all() and not batch.learns[:, 2:].any()
    *_, batch = batch_of(3, start=4 * T * B)
    assert not batch.learns[:, 2:].any()
    *_, batch = batch_of(4, start=4 * T * B)
    assert batch.learns.all()
