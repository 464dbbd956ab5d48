"""V-trace: what one update does, on made-up rollouts. That it learns is in test_learning.py, what
it shares with other learners in test_learners.py.
"""

import math

import pytest
import torch

from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import ReplaySettings
from tests.helpers.made_up import MORE, MOVES, OBS, B, Numbers, made_up, weights


def test_the_first_pass_finds_the_policy_where_it_was():
    policy, rollout = made_up(values=False)
    metrics = VTrace(policy, n_minibatches=1).update(rollout)
    assert metrics["loss/kl"].item() == pytest.approx(0, abs=1e-6)
    assert metrics["loss/rho"].item() == pytest.approx(1, abs=1e-5)
    assert metrics["loss/effective_samples"].item() == pytest.approx(1, abs=1e-5)
    assert 0 < metrics["loss/entropy"].item() < math.log(3)
    assert set(metrics) == {
        f"loss/{key}"
        for key in (
            *("policy", "value", "entropy", "kl", "rho", "clip_fraction", "effective_samples"),
            *("advantage", "grad_norm", "explained_variance", "skipped_steps"),
        )
    }


@pytest.mark.parametrize(
    "ratio, rho, clip_fraction", [(2.0, 1.0, 1.0), (0.5, 0.5, 0.0), (math.e**60, 1.0, 1.0)]
)
def test_ratios_by_hand(ratio, rho, clip_fraction):
    """In every row the policy finds the action so many times as probable as it was."""
    policy, rollout = made_up(values=False)
    rollout.logprobs -= math.log(ratio)
    metrics = VTrace(policy, n_minibatches=2, lr=1e-30).update(rollout)
    assert metrics["loss/rho"].item() == pytest.approx(rho, abs=1e-5)
    assert metrics["loss/clip_fraction"].item() == clip_fraction
    if ratio < 1e8:
        assert metrics["loss/kl"].item() == pytest.approx(ratio - 1 - math.log(ratio), abs=1e-5)
    assert all(value.isfinite() for value in metrics.values())
    assert metrics["loss/skipped_steps"].item() == 0


def test_the_effective_samples_falls_as_ratios_differ():
    policy, rollout = made_up(values=False)
    rollout.logprobs[:, ::2] += math.log(3)  # half of the lanes weigh a third
    metrics = VTrace(policy, n_minibatches=1).update(rollout)
    # 24 - 0 and 24 - 2 rows are valid, as lanes 1 and 4 have one reset each: 23 weigh 1/3, 23 1
    share = (1 / 3 + 1) ** 2 / (2 * (1 / 9 + 1))
    assert metrics["loss/effective_samples"].item() == pytest.approx(share, abs=1e-4)


def test_advantages_are_measured_in_their_own_size_or_the_floor():
    def losses(floor):
        policy, rollout = made_up(values=False)
        made = VTrace(policy, n_minibatches=1, lr=1e-30, advantage_floor=floor).update(rollout)
        return made["loss/policy"].item(), made["loss/advantage"].item()

    own, size = losses(1e-6)
    assert size > 0
    assert losses(size / 2)[0] == pytest.approx(own, rel=1e-5)
    for times in (2, 5):
        assert losses(times * size)[0] == pytest.approx(own / times, rel=1e-5)


def test_good_actions_become_likelier_and_bad_ones_rarer():
    policy, rollout = made_up(values=False)
    rollout.reward[:] = (rollout.actions[..., 0] == 2).float()
    before = policy.unroll(rollout.obs, rollout.starts, rollout.state).logits.exp().mean((0, 1, 2))
    learner = VTrace(policy, lr=3e-3, gamma=0.0)
    for _ in range(5):
        learner.update(rollout)
    after = policy.unroll(rollout.obs, rollout.starts, rollout.state).logits.exp().mean((0, 1, 2))
    assert after[2] > before[2] + 0.05 and after[0] < before[0] and after[1] < before[1]


def test_actions_that_the_policy_would_never_take_teach_the_policy_nothing():
    """Their ratios are 0: the value keeps its own estimate, too."""
    policy, rollout = made_up(values=False)
    rollout.logprobs += 200.0
    before = weights(policy)
    metrics = VTrace(policy, entropy_coef=0.0, lr=1e-2).update(rollout)
    assert metrics["loss/policy"].item() == metrics["loss/value"].item() == 0
    torch.testing.assert_close(weights(policy), before, rtol=0, atol=1e-6)


@pytest.mark.parametrize("ended, error", [(False, 0.0), (True, 1.0)])
def test_values_are_told_what_follows_the_last_row(ended, error):
    """Nothing is paid, every value is 1 and gamma is 1: what follows the last row is worth 1, so
    all values are right, unless the episode ends there: then each is 1 too much.
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


def test_what_an_invalid_row_holds_teaches_nothing():
    results = []
    for corrupt in (False, True):
        policy, rollout = made_up(values=False)
        if corrupt:
            ignored = rollout.reset.nonzero(as_tuple=True)
            assert len(ignored[0]) == 2
            rollout.reward[ignored], rollout.logprobs[ignored] = 1e3, -500.0
            rollout.actions[ignored] = (rollout.actions[ignored] + 1) % 3
        metrics = VTrace(policy, n_epochs=2, n_minibatches=2).update(rollout)
        results.append((metrics, weights(policy)))
    (clean_metrics, clean), (dirty_metrics, dirty) = results
    assert torch.equal(clean, dirty) and clean_metrics == dirty_metrics


@pytest.mark.parametrize("n_minibatches", [2, B])
def test_lanes_that_do_not_learn_change_no_bit_of_weights_or_statistics(n_minibatches):
    """One lane learns at some times: its traces pass through its other rows as if the policy had
    acted there.
    """
    results = []
    for changed in (False, True):
        policy, rollout = made_up(privileged=MORE, values=False)
        rollout.learns[:, [0, 4]] = False
        rollout.learns[2:4, 3] = False
        if changed:
            rollout.logprobs[2:4, 3] += torch.tensor([9.0, -200.0])
            for lanes in (rollout.obs, rollout.privileged, rollout.reward):
                lanes[:, [0, 4]] = torch.randn(lanes[:, [0, 4]].shape) * 50 + 9
            rollout.logprobs[:, 0], rollout.logprobs[:, 4] = -200.0, 3.0
            rollout.actions[:, [0, 4]] = (rollout.actions[:, [0, 4]] + 1) % 3
            rollout.terminal[5, 0] = rollout.truncated[6, 4] = rollout.starts[4, 0] = True
            rollout.state.cell[[0, 4]] = 7.0
        learner = VTrace(policy, n_epochs=2, n_minibatches=n_minibatches, lr=1e-2)
        metrics = learner.update(rollout)
        results.append((metrics, policy.state_dict()))
    (clean_metrics, clean), (metrics, dirty) = results
    assert all(torch.equal(clean[key], dirty[key]) for key in clean)
    assert metrics == clean_metrics and metrics["loss/auxiliary"] > 0


def test_returns_set_the_scale_of_values_and_change_no_prediction():
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
    """After so many updates in `Numbers`: the learner, with what collects for it, and metrics."""
    env = env or Numbers()
    policy = Policy(env.obs_space, env.action_space, width=8)
    settings = ReplaySettings(capacity=3 * 5 * B, **how.pop("replay", {}))
    learner = VTrace(policy, n_steps=5, n_minibatches=2, buffer="replay", replay=settings, **how)
    learner.collect = learner.collector(env)
    for _ in range(n_updates):
        metrics = learner.update(learner.collect())
    return learner, {key.removeprefix("loss/"): value.item() for key, value in metrics.items()}


@pytest.mark.parametrize("lag", [0, 2])
def test_how_old_what_is_replayed_was_is_told(lag):
    """Of three rollouts two can be drawn, 1 and 2 updates old, and as much as they acted late."""
    learner, metrics = replaying(12, lag=lag)
    assert 1 + lag < metrics["staleness"] < 2 + lag
    assert metrics["kl"] < metrics["replayed_kl"]
    assert metrics["replayed_effective_samples"] <= 1 and metrics["replayed_rho"] <= 1
    _, first = replaying(1)
    assert first["staleness"] == first["replayed_rho"] == first["replayed_effective_samples"] == 0


def test_what_surprised_most_is_drawn_most():
    learner, _ = replaying(12, replay=dict(alpha=1.0))
    priorities = learner.replay.tree.priorities
    drawn = priorities[priorities > 0]
    assert len(drawn.unique()) > B, "each has its own"
    uniform, _ = replaying(12)
    drawn = uniform.replay.tree.priorities
    assert set(drawn.tolist()) == {0.0, 1.0}


def test_sequences_count_in_the_loss_by_their_weights():
    policy, rollout = made_up(values=False)
    learner, rows = VTrace(policy), torch.arange(B)
    batch = learner._batch(rollout, rows)
    _, ones, _ = learner._losses(batch, B)
    batch["weight"] = 2 * batch.weight
    _, twos, _ = learner._losses(batch, B)
    for name in ("policy", "value"):
        assert twos[name].item() == pytest.approx(2 * ones[name].item(), rel=1e-5)
    assert twos["entropy"] == ones["entropy"] and ones["policy"].abs() > 1e-3


def test_a_rollout_with_a_bad_number_is_never_replayed():
    learner, metrics = replaying(5, Numbers(bad_steps=(22,)), replay=dict(ratio=10.0))
    assert metrics["skipped_steps"] == 2
    for _ in range(4):
        metrics = learner.update(learner.collect())
        assert metrics["loss/skipped_steps"] == 0
    assert metrics["loss/staleness"] > 0


def test_what_is_replayed_is_learnt_from():
    """From fresh rollouts alone with a share of next to none, and as many replayed."""
    ends = []
    for ratio in (1e-6, 1.0):
        learner, metrics = replaying(6, replay=dict(ratio=ratio), lr=1e-2)
        assert metrics["skipped_steps"] == 0
        ends.append(weights(learner.policy))
    assert not torch.allclose(*ends, atol=1e-3)


@pytest.mark.parametrize(
    "settings, told",
    [
        (dict(replay=ReplaySettings(ratio=2.0)), "those of buffer=replay"),
        (
            dict(buffer="replay", replay=ReplaySettings(length=40), n_steps=32),
            "leave replay.length",
        ),
        (dict(buffer="replay", replay=ReplaySettings(burn_in=9, length=9)), "shorter than"),
        (dict(lag=3), "lag: 3 is out of range"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings, told):
    with pytest.raises(ValueError, match=told):
        VTrace(made_up()[0], **settings)


def test_a_policy_without_a_critic_is_refused():
    policy = Policy(OBS, MOVES, critic=None)
    with pytest.raises(ValueError, match="needs a policy with a critic"):
        VTrace(policy)
