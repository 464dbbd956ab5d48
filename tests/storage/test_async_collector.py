"""The async collector: acting weights are an exact number of updates old, and the numbers match a
loop that stores old weights.
"""

import copy

import pytest
import torch

from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.collector import Collector
from megastep.agents.storage.rollout import make_rollout
from tests.helpers.made_up import Numbers
from tests.helpers.synchronisation import no_synchronisation

T = 5
SETTINGS = dict(n_steps=T, n_minibatches=2, lr=1e-2, gamma=0.99, advantage_floor=0.3)


def policy_of(env):
    policy = Policy(env.obs_space, env.action_space, width=8, bf16=False).to(env.device)
    policy.clear_stats()  # as a learner's collector does
    return policy


def acted(rollout):
    """Returns copies of observations, actions and log-probabilities."""
    return [rollout.obs.clone(), rollout.actions.clone(), rollout.logprobs.clone()]


def by_hand(lag, n_updates, device="cpu"):
    """Runs a loop that stores old weights in a list. Returns the policy and `acted` per rollout."""
    env = Numbers(device)
    policy, rollouts, weights = policy_of(env), [], []
    learner, actor = VTrace(policy, **SETTINGS), policy_of(env)
    actor.generator = policy.generator
    collect = Collector(env, actor, make_rollout(env, policy, T, values=False))
    for n in range(n_updates):
        weights.append(copy.deepcopy(policy.state_dict()))
        actor.load_state_dict(weights[max(n - lag, 0)])
        rollout = collect()
        rollouts.append(acted(rollout))
        learner.update(rollout)
    return policy, rollouts


def train(lag, n_updates, device="cpu", graph=False):
    """Trains with a lag. Returns the policy, `acted` per rollout, and the collector."""
    env = Numbers(device)
    policy, rollouts = policy_of(env), []
    learner = VTrace(policy, lag=lag, graph=graph, **SETTINGS)
    collect = learner.collector(env)
    for _ in range(n_updates):
        rollout = collect()
        assert rollout is collect.rollout
        rollouts.append(acted(rollout))
        learner.update(rollout)
    if lag:
        collect.wait()
    return policy, rollouts, collect


def flat(policy):
    return torch.cat([value.flatten().float() for value in policy.state_dict().values()])


@pytest.mark.parametrize("lag", [0, 1, 2])
def test_matches_loop_with_stored_weights(lag):
    """Running statistics of observations are as old as the weights."""
    (expected, expected_rollouts), (policy, rollouts, _) = by_hand(lag, 6), train(lag, 6)
    for rollout, expected_rollout in zip(rollouts, expected_rollouts, strict=True):
        assert all(map(torch.equal, rollout, expected_rollout))
    assert torch.equal(flat(policy), flat(expected))


def test_weights_loaded_after_construction_are_used():
    """A resumed trainer makes its collector first and loads weights later."""
    env, other = Numbers(), policy_of(Numbers())
    policy = policy_of(env)
    collect = VTrace(policy, lag=2, **SETTINGS).collector(env)
    with torch.no_grad():
        other.output.linear.weight.mul_(100)
    policy.load_state_dict(other.state_dict())
    rollout = collect()
    logits = other.unroll(rollout.obs, rollout.starts, rollout.state).logits[:-1]
    expected = other.output.logprob(logits, rollout.actions)
    torch.testing.assert_close(rollout.logprobs, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.cuda
@pytest.mark.parametrize("lag", [1, 2])
def test_gpu_matches_loop_with_stored_weights(lag):
    (expected, expected_rollouts), (policy, rollouts, collect) = (
        by_hand(lag, 8, "cuda"),
        train(lag, 8, "cuda", graph=True),
    )
    assert collect.graph is not None
    for rollout, expected_rollout in zip(rollouts, expected_rollouts, strict=True):
        assert torch.equal(rollout[0], expected_rollout[0]), "observations ignore actions"
    # a captured graph may use other kernels; an update moves weights by some 1e-2
    torch.testing.assert_close(flat(policy), flat(expected), rtol=1e-3, atol=1e-3)
    other = train(lag - 1, 8, "cuda")[0]
    assert (flat(policy) - flat(other)).abs().max() > 1e-2


@pytest.mark.cuda
def test_collect_and_update_never_synchronise():
    env = Numbers("cuda")
    policy = policy_of(env)
    learner = VTrace(policy, lag=1, graph=True, **SETTINGS)
    collect = learner.collector(env)
    for _ in range(5):
        learner.update(collect())
    with no_synchronisation():
        for _ in range(3):
            learner.update(collect())
    collect.wait()
