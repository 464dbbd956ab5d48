"""Acting ahead: the weights that act are an exact number of updates old, and the numbers are those
of a loop by hand.
"""

import copy

import pytest
import torch

from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.async_collector import AsyncCollector
from megastep.agents.storage.rollout import Collector, make_rollout
from tests.helpers.made_up import B, Numbers

T = 5
HOW = dict(n_steps=T, n_minibatches=2, lr=1e-2)


def policy_of(env):
    return Policy(env.obs_space, env.action_space, width=8, bf16=False).to(env.device)


def recorded(rollout):
    return [rollout.obs.clone(), rollout.actions.clone(), rollout.logprobs.clone()]


def by_hand(lag, n_updates, device="cpu"):
    """Keeps old weights in a list. Returns the policy, and what was acted in each rollout."""
    env = Numbers(device)
    policy, seen, old = policy_of(env), [], []
    learner, actor = VTrace(policy, **HOW), policy_of(env)
    actor.generator = policy.generator
    collect = Collector(env, actor, make_rollout(env, policy, T, values=False))
    for n in range(n_updates):
        old.append(copy.deepcopy(policy.state_dict()))
        actor.load_state_dict(old[max(n - lag, 0)])
        rollout = collect()
        seen.append(recorded(rollout))
        learner.update(rollout)
    return policy, seen


def ahead(lag, n_updates, device="cpu", graph=False):
    env = Numbers(device)
    policy, seen = policy_of(env), []
    learner = VTrace(policy, lag=lag, graph=graph, **HOW)
    collect = learner.collector(env)
    for _ in range(n_updates):
        rollout = collect()
        assert rollout is collect.rollout
        seen.append(recorded(rollout))
        learner.update(rollout)
    if lag:
        collect.wait()
    return policy, seen, collect


def flat(policy):
    return torch.cat([value.flatten().float() for value in policy.state_dict().values()])


@pytest.mark.parametrize("lag", [0, 1, 2])
def test_it_is_the_loop_by_hand_that_keeps_old_weights(lag):
    """Statistics of observations are among the weights that are old."""
    (expected, acted), (policy, seen, _) = by_hand(lag, 6), ahead(lag, 6)
    for rollout, hand in zip(seen, acted, strict=True):
        assert all(map(torch.equal, rollout, hand))
    assert torch.equal(flat(policy), flat(expected))


def test_each_lag_is_another_loop():
    first, second, third = (ahead(lag, 6)[0] for lag in (0, 1, 2))
    assert not torch.equal(flat(first), flat(second))
    assert not torch.equal(flat(second), flat(third))


def test_the_first_rollouts_are_acted_in_with_the_first_weights():
    _, seen, _ = ahead(2, 5)
    env = Numbers()
    policy = policy_of(env)
    collect = Collector(env, policy, make_rollout(env, policy, T, values=False))
    same = [all(map(torch.equal, rollout, recorded(collect()))) for rollout in seen]
    assert same == [True, True, True, False, False]


def test_all_that_a_rollout_holds_is_handed_over():
    env = Numbers()
    policy = policy_of(env)
    collect = AsyncCollector(env, policy, make_rollout(env, policy, T, values=False), 1)
    collect.slots[0].rollout.learns[2, 3] = False
    rollout = collect()
    assert not rollout.learns[2, 3] and rollout.learns.sum() == (T + 1) * B - 1
    assert torch.equal(rollout.metrics.age[:, 0], torch.arange(1.0, T + 1))
    assert rollout.truncated.sum() == 0 and rollout.starts[0].all()
    state = rollout.state.cell.clone()
    assert not state.any() and collect().state.cell.any()


def test_who_goes_on_acts_with_the_weights_of_then():
    """A trainer makes its collector first and loads weights later."""
    env, other = Numbers(), policy_of(Numbers())
    policy = policy_of(env)
    collect = VTrace(policy, lag=2, **HOW).collector(env)
    with torch.no_grad():
        other.output.linear.weight.mul_(100)
    policy.load_state_dict(other.state_dict())
    rollout = collect()
    logits = other.unroll(rollout.obs, rollout.starts, rollout.state).logits[:-1]
    expected = other.output.logprob(logits, rollout.actions)
    torch.testing.assert_close(rollout.logprobs, expected, rtol=1e-4, atol=1e-4)


def test_opponents_are_refused():
    env = Numbers()
    env.learners = torch.ones(B, dtype=torch.bool)
    with pytest.raises(ValueError, match="lag=0, or no opponents"):
        VTrace(policy_of(env), lag=1, **HOW).collector(env)


def test_memory_is_needed_for_each_rollout_ahead():
    env = Numbers()
    need = [VTrace(policy_of(env), lag=lag, **HOW).bytes_per_env(env) for lag in (0, 1, 2)]
    assert need[2] - need[1] == need[1] - need[0] > 0


@pytest.mark.cuda
@pytest.mark.parametrize("lag", [1, 2])
def test_on_a_gpu_it_is_the_loop_by_hand(lag):
    (expected, acted), (policy, seen, collect) = (
        by_hand(lag, 8, "cuda"),
        ahead(lag, 8, "cuda", graph=True),
    )
    assert collect.graph is not None
    for rollout, hand in zip(seen, acted, strict=True):
        assert torch.equal(rollout[0], hand[0]), "what is seen does not depend on what is done"
    # kernels are chosen anew where a graph is captured; an update moves weights by some 1e-2
    torch.testing.assert_close(flat(policy), flat(expected), rtol=1e-3, atol=1e-3)
    other = ahead(lag - 1, 8, "cuda")[0]
    assert (flat(policy) - flat(other)).abs().max() > 1e-2


@pytest.mark.cuda
@pytest.mark.parametrize("lag", [1, 2])
def test_on_a_gpu_the_same_seed_gives_the_same_numbers(lag):
    (first, acted, _), (second, again, _) = (ahead(lag, 12, "cuda", graph=True) for _ in range(2))
    for one, other in zip(acted, again, strict=True):
        assert all(map(torch.equal, one, other))
    assert torch.equal(flat(first), flat(second))


@pytest.mark.cuda
def test_collecting_and_learning_never_synchronise():
    env = Numbers("cuda")
    policy = policy_of(env)
    learner = VTrace(policy, lag=1, graph=True, **HOW)
    collect = learner.collector(env)
    for _ in range(5):
        learner.update(collect())
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(3):
            learner.update(collect())
    finally:
        torch.cuda.set_sync_debug_mode("default")
    collect.wait()
