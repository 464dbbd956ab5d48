"""PPO's update on random rollouts. test_learning.py tests that PPO learns, test_learners.py what
all learners have in common.
"""

import math

import pytest
import torch

from megastep import spaces
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.rollout import Rollout
from megastep.arrdict import arrdict
from tests.helpers.made_up import MOVES, OBS, WIDTH, B, Numbers, T, made_up, weights


def test_first_pass_has_zero_kl():
    policy, rollout = made_up()
    metrics = PPO(policy, n_minibatches=1).update(rollout)
    assert metrics["loss/kl"].item() == pytest.approx(0, abs=1e-6)
    assert metrics["loss/clip_fraction"].item() == metrics["loss/skipped_steps"].item() == 0
    # with ratios of 1 the policy loss is the mean of normalised advantages
    assert metrics["loss/policy"].item() == pytest.approx(0, abs=1e-6)
    assert 0 < metrics["loss/entropy"].item() < math.log(3)
    names = "policy value entropy kl clip_fraction grad_norm explained_variance skipped_steps"
    assert set(metrics) == {f"loss/{key}" for key in names.split()}


def test_kl_and_clip_fraction_match_hand_calculation():
    # every action was half as likely when it was taken: ratio 2, so KL = 2 - 1 - log 2 in every row
    policy, rollout = made_up()
    rollout.logprobs -= math.log(2)
    metrics = PPO(policy, n_minibatches=2, lr=1e-30).update(rollout)
    assert metrics["loss/kl"].item() == pytest.approx(1 - math.log(2), abs=1e-5)
    assert metrics["loss/clip_fraction"].item() == 1


def test_update_without_learning_lanes_changes_nothing():
    """Without a skip, Adam's running means would still move the weights."""
    policy, rollout = made_up()
    learner = PPO(policy, n_minibatches=2, lr=1e-2)
    learner.update(rollout)
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    means = [mean.clone() for mean in learner.optimizer.means]
    rollout.learns[:] = False
    learner.update(rollout)
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())
    assert all(map(torch.equal, learner.optimizer.means, means))
    assert learner.check.read(rollout.floats()) == (None, 0), "not counted as skipped"


def test_nonfinite_gradient_is_skipped():
    policy, rollout = made_up()
    rollout.logprobs[2, 3] = -200.0  # a ratio of e^200 in one of six minibatches
    before = weights(policy)
    learner = PPO(policy, n_minibatches=B)
    metrics = learner.update(rollout)
    assert metrics["loss/skipped_steps"].item() == 1
    assert not torch.equal(weights(policy), before) and weights(policy).isfinite().all()
    assert all(value.isfinite() for value in metrics.values())
    assert learner.check.read(rollout.floats()) == (
        None,
        0,
    )  # the update as a whole was not skipped


def test_steps_after_target_kl_are_not_counted_as_skipped():
    # The first minibatch has a KL divergence of 1 - log 2 = .31 nats, which stops the update. The
    # gradients of the other minibatches are not finite.
    policy, rollout = made_up()
    rollout.logprobs -= math.log(2)
    next(policy.parameters()).register_hook(lambda grad: grad * math.nan)
    stopped = PPO(policy, n_minibatches=B, target_kl=0.1)
    assert stopped.update(rollout)["loss/skipped_steps"].item() == 0
    assert stopped.check.read(rollout.floats()) == (None, 0)
    continued = PPO(policy, n_minibatches=B, target_kl=1.0)
    assert continued.update(rollout)["loss/skipped_steps"].item() == B
    assert continued.check.read(rollout.floats()) == (None, 1)


def test_update_stays_stopped_after_target_kl():
    """Each minibatch is a lane. One lane has a KL divergence of .31 nats, the others of 0."""
    policy, rollout = made_up()
    rollout.logprobs[:, 2] -= math.log(2)
    learner = PPO(policy, n_epochs=3, n_minibatches=B, lr=1e-30, target_kl=0.1)
    learner.update(rollout)
    assert learner.optimizer.n_steps < B


@pytest.mark.parametrize("ratio, loss", [(2.0, 0.4), (0.5, 0.15)])
def test_surrogate_is_the_smaller_of_clipped_and_unclipped(ratio, loss):
    """Half of the advantages are 1, the others -1. With a clip of .2, a ratio of 2 gives 1.2 and
    -2, a ratio of 1/2 gives .5 and -.8.
    """
    policy, rollout = made_up()
    rollout.logprobs -= math.log(ratio)
    rollout.values.zero_()
    rollout.reward[:] = torch.tensor([1.0, -1.0]).repeat(B // 2)
    learner = PPO(policy, n_epochs=1, n_minibatches=1, lr=1e-30, gamma=0.0, clip=0.2)
    assert learner.update(rollout)["loss/policy"].item() == pytest.approx(loss, abs=1e-4)


@pytest.mark.parametrize("value_clip, loss", [(None, 1.0), (0.2, 1.345), (0.6, 1.0)])
def test_value_clip(value_clip, loss):
    """The value fell from .5 to 0. Half of the targets are 1, the others -1. Clipped at a distance
    of .2 it is .3, whose squared errors are .49 and 1.69: larger only where the value improved, and
    there the gradient stops.
    """
    policy, rollout = made_up()
    rollout.reward[:] = torch.tensor([1.0, -1.0]).repeat(B // 2)
    rollout.values[:] = 0.5
    linear = policy.critic.output.linear
    torch.nn.init.zeros_(linear.weight)
    learner = PPO(policy, n_minibatches=1, lr=1e-3, gamma=0.0, value_clip=value_clip)
    assert learner.update(rollout)["loss/value"].item() == pytest.approx(loss, abs=1e-5)
    if loss > 1:
        assert linear.bias.item() == pytest.approx(1e-3, rel=1e-2)


@pytest.mark.parametrize(
    "over, loss, has_gradient",
    [("none", -2.5, True), ("rollout", 0, True), ("minibatch", 0, False)],
)
def test_normalise_advantage(over, loss, has_gradient):
    """Lane i is a minibatch, and all its advantages are i."""
    policy, rollout = made_up()
    rollout.values.zero_()
    rollout.reward[:] = torch.arange(B)
    settings = dict(lr=1e-30, gamma=0.0, value_coef=0.0, entropy_coef=0.0)
    metrics = PPO(policy, n_minibatches=B, normalise_advantage=over, **settings).update(rollout)
    # the two lanes with an invalid row count less in the mean over the rollout
    assert metrics["loss/policy"].item() == pytest.approx(loss, abs=0.02)
    assert (metrics["loss/grad_norm"].item() > 1e-3) == has_gradient


def test_target_kl_stops_update():
    ends = []
    for settings in (dict(n_epochs=1), dict(n_epochs=4, target_kl=1e-4), dict(n_epochs=4)):
        policy, rollout = made_up()
        PPO(policy, lr=3e-2, n_minibatches=1, **settings).update(rollout)
        ends.append(weights(policy))
    once, stopped, four_times = ends
    assert torch.equal(stopped, once) and not torch.equal(four_times, once)


def test_update_normalises_observations():
    policy, rollout = made_up()
    rollout.obs += 5
    PPO(policy).update(rollout)
    norm, last = policy.intake.norms[0], rollout.obs[-1]
    torch.testing.assert_close(norm.mean, last.mean(0))
    torch.testing.assert_close(norm(last).std(0, correction=0), torch.ones(1, 4))


def test_fewer_lanes_than_minibatches_raises():
    policy, rollout = made_up()
    with pytest.raises(ValueError, match="6 lanes .* 7 minibatches.*n_minibatches"):
        PPO(policy, n_minibatches=7).update(rollout)


def test_nested_action_space():
    moves = arrdict(move=MOVES, fire=spaces.MultiDiscrete(1, 2))
    policy = Policy(OBS, moves, width=WIDTH)
    rollout = Rollout(T, B, OBS, moves, policy.initial(B))
    rollout.logprobs[:] = math.log(1 / 6)
    rollout.reward[:] = torch.randn(T, B)
    before = weights(policy)
    metrics = PPO(policy).update(rollout)
    assert metrics["loss/entropy"].item() == pytest.approx(math.log(6), abs=1e-3)
    assert not torch.equal(weights(policy), before)


@pytest.mark.cuda
def test_same_seed_collects_and_learns_the_same_bits_on_a_gpu():
    ends = []
    for _ in range(2):
        env = Numbers("cuda")
        policy = Policy(env.obs_space, env.action_space, width=256).cuda()
        learner = PPO(policy, n_steps=T, n_minibatches=2, lr=1e-2, graph=True)
        collect = learner.collector(env)
        for _ in range(5):
            rollout = collect()
            learner.update(rollout)
        ends.append((weights(policy), rollout.logprobs.clone(), rollout.actions.clone()))
    for one, other in zip(*ends, strict=True):
        assert torch.equal(one, other)
