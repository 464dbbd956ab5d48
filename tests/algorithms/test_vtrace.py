"""V-trace's update on random rollouts. test_learning.py tests that V-trace learns, test_learners.py
what all learners have in common.
"""

import math

import pytest
import torch

from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import ReplaySettings
from tests.helpers.made_up import B, Numbers, made_up, weights


def test_first_pass_has_zero_kl():
    policy, rollout = made_up(values=False)
    metrics = VTrace(policy, n_minibatches=1).update(rollout)
    assert metrics["loss/kl"].item() == pytest.approx(0, abs=1e-6)
    assert metrics["loss/rho"].item() == pytest.approx(1, abs=1e-5)
    assert metrics["loss/effective_samples"].item() == pytest.approx(1, abs=1e-5)
    assert 0 < metrics["loss/entropy"].item() < math.log(3)
    names = "policy value entropy kl rho clip_fraction effective_samples advantage grad_norm"
    names += " explained_variance skipped_steps"
    assert set(metrics) == {f"loss/{key}" for key in names.split()}


@pytest.mark.parametrize(
    "ratio, rho, clip_fraction", [(2.0, 1.0, 1.0), (0.5, 0.5, 0.0), (math.e**60, 1.0, 1.0)]
)
def test_ratio_metrics_match_hand_calculation(ratio, rho, clip_fraction):
    """In every row the policy finds the action `ratio` times as likely as it was."""
    policy, rollout = made_up(values=False)
    rollout.logprobs -= math.log(ratio)
    metrics = VTrace(policy, n_minibatches=2, lr=1e-30).update(rollout)
    assert metrics["loss/rho"].item() == pytest.approx(rho, abs=1e-5)
    assert metrics["loss/clip_fraction"].item() == clip_fraction
    if ratio < 1e8:
        assert metrics["loss/kl"].item() == pytest.approx(ratio - 1 - math.log(ratio), abs=1e-5)
    assert all(value.isfinite() for value in metrics.values())
    assert metrics["loss/skipped_steps"].item() == 0


def test_effective_samples_falls_as_ratios_differ():
    policy, rollout = made_up(values=False)
    rollout.logprobs[:, ::2] += math.log(3)  # half of the lanes have ratio 1/3
    metrics = VTrace(policy, n_minibatches=1).update(rollout)
    # lanes 1 and 4 have one reset each: 23 valid rows have ratio 1/3, 23 have 1
    share = (1 / 3 + 1) ** 2 / (2 * (1 / 9 + 1))
    assert metrics["loss/effective_samples"].item() == pytest.approx(share, abs=1e-4)


def test_advantage_floor():
    def losses(floor):
        policy, rollout = made_up(values=False)
        learner = VTrace(policy, n_minibatches=1, lr=1e-30, advantage_floor=floor)
        metrics = learner.update(rollout)
        return metrics["loss/policy"].item(), metrics["loss/advantage"].item()

    policy_loss, size = losses(1e-6)
    assert size > 0
    assert losses(size / 2)[0] == pytest.approx(policy_loss, rel=1e-5)
    for factor in (2, 5):
        assert losses(factor * size)[0] == pytest.approx(policy_loss / factor, rel=1e-5)


def test_actions_of_probability_zero_are_ignored():
    """Their ratios are 0, so the value keeps its estimate, too."""
    policy, rollout = made_up(values=False)
    rollout.logprobs += 200.0
    before = weights(policy)
    metrics = VTrace(policy, entropy_coef=0.0, lr=1e-2).update(rollout)
    assert metrics["loss/policy"].item() == metrics["loss/value"].item() == 0
    torch.testing.assert_close(weights(policy), before, rtol=0, atol=1e-6)


@pytest.mark.parametrize("ended, error", [(False, 0.0), (True, 1.0)])
def test_bootstraps_from_last_row(ended, error):
    """The reward is 0, every value is 1 and gamma is 1. So all values are right, unless the episode
    ends after the last row: then each is 1 too large.
    """
    policy, rollout = made_up(values=False)
    rollout.reward.zero_(), rollout.terminal.zero_(), rollout.truncated.zero_()
    rollout.starts[1:] = False
    rollout.terminal[-1] = ended
    with torch.no_grad():
        policy.critic.output.linear.weight.zero_()
        policy.critic.output.linear.bias.fill_(1.0)
        logits = policy.unroll(rollout.obs, rollout.starts, rollout.state).logits[:-1]
        rollout.logprobs[:] = policy.output.logprob(logits, rollout.actions)
    metrics = VTrace(policy, n_minibatches=1, gamma=1.0, lambda_=1.0).update(rollout)
    assert metrics["loss/value"].item() == pytest.approx(error, abs=1e-5)


def test_popart_sets_scale_and_keeps_predictions():
    policy, rollout = made_up(values=False)
    rollout.reward += 100
    VTrace(policy, n_minibatches=1, gamma=0.0, lr=1e-30).update(rollout)
    value = policy.critic.output
    valid = ~rollout.reset
    assert value.mean.item() == pytest.approx(rollout.reward[valid].mean().item(), rel=1e-4)
    spread = rollout.reward[valid].std(correction=0).item()
    assert value.scale.item() == pytest.approx(spread, rel=1e-3)
    out = policy.unroll(rollout.obs, rollout.starts, rollout.state)
    assert policy.value(out.features).abs().max() < 5


def replaying(n_updates, env=None, **how):
    """Returns a learner with a replay buffer after some updates, and its last metrics."""
    env = env or Numbers()
    policy = Policy(env.obs_space, env.action_space, width=8)
    settings = ReplaySettings(capacity=3 * 5 * B, **how.pop("replay", {}))
    learner = VTrace(policy, n_steps=5, n_minibatches=2, buffer="replay", replay=settings, **how)
    learner.collect = learner.collector(env)
    for _ in range(n_updates):
        metrics = learner.update(learner.collect())
    return learner, {key.removeprefix("loss/"): value.item() for key, value in metrics.items()}


def test_staleness_metric():
    """Of three rollouts two can be drawn, 1 and 2 updates old."""
    learner, metrics = replaying(12)
    assert 1 < metrics["staleness"] < 2
    assert metrics["kl"] < metrics["replayed_kl"]
    assert metrics["replayed_effective_samples"] <= 1 and metrics["replayed_rho"] <= 1
    _, first = replaying(1)  # which tells only the size of returns
    assert all(math.isnan(first[name]) for name in ("staleness", "replayed_rho", "policy"))


def test_priorities_are_those_of_replayed_lanes():
    """Rewards of fresh lanes do not change them."""
    learner, _ = replaying(12, replay=dict(alpha=1.0))
    batch, priorities = learner._batch(learner.collect(), torch.arange(B)), []
    for lanes in (None, slice(B), slice(B, None)):
        if lanes is not None:
            batch.reward[:, lanes] += 10.0
        learner._losses(batch, B)
        priorities.append(learner.replay_buffer.tree.priorities.clone())
    first, fresh, replayed = priorities
    assert torch.equal(first, fresh) and not torch.equal(first, replayed)


def test_importance_weights_scale_losses():
    policy, rollout = made_up(values=False)
    learner = VTrace(policy)
    batch = learner._batch(rollout, torch.arange(B))
    _, ones, _ = learner._losses(batch, B)
    batch["weight"] = 2 * batch.weight
    _, twos, _ = learner._losses(batch, B)
    for name in ("policy", "value"):
        assert twos[name].item() == pytest.approx(2 * ones[name].item(), rel=1e-5)
    assert twos["entropy"] == ones["entropy"] and ones["policy"].abs() > 1e-3


def test_nonfinite_rollout_is_never_replayed():
    learner, metrics = replaying(5, Numbers(bad_steps=(22,)), replay=dict(ratio=10.0))
    assert metrics["skipped_steps"] == 2
    for _ in range(4):
        metrics = learner.update(learner.collect())
        assert metrics["loss/skipped_steps"] == 0
    assert metrics["loss/staleness"] > 0
