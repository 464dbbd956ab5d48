"""The critic: an asymmetric one sees privileged observations, and the actor never does."""

import math

import pytest
import torch

from megastep import spaces
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict, stack

T, B, WIDTH = 8, 6, 16
OBS, MOVES = arrdict(eye=spaces.MultiVector(1, 4)), spaces.MultiDiscrete(1, 3)
PRIVILEGED = arrdict(episode=spaces.MultiVector(1, 2), unseen=spaces.MultiVector(1, 5))


def policy_of(critic="asymmetric", seed=0):
    """Returns a policy far from uniform, so that anything that reached the logits would show."""
    policy = Policy(OBS, MOVES, PRIVILEGED, width=WIDTH, critic=critic, seed=seed)
    with torch.no_grad():
        policy.output.linear.weight.mul_(100)
    return policy


def values_of(tree, *lead, seed=0):
    """Returns random values (*lead, ...) of a tree of spaces."""
    generator = torch.Generator().manual_seed(seed)
    return tree.map(lambda space: torch.randn(*lead, *space.shape, generator=generator))


def world_of(privileged=None, seed=0):
    """Returns a world of B lanes, half of them on their first observation."""
    world = arrdict(obs=values_of(OBS, B, seed=seed), reset=torch.arange(B) % 2 == 0)
    return world if privileged is None else arrdict(world, privileged=privileged)


# ---- Acting ----


VALUES = {
    "zeros": lambda: values_of(PRIVILEGED, B) * 0,
    "numbers": lambda: values_of(PRIVILEGED, B, seed=3) * 1e3,
    "NaN": lambda: values_of(PRIVILEGED, B) * math.nan,
    "infinite": lambda: values_of(PRIVILEGED, B) * math.inf,
    "nothing": lambda: None,
}


@pytest.mark.parametrize("name", VALUES)
def test_actions_do_not_depend_on_privileged(name):
    """Five steps, so that privileged observations could also pass through the hidden state."""
    runs = []
    for privileged in (values_of(PRIVILEGED, B, seed=9), VALUES[name]()):
        policy = policy_of()
        state, decisions = policy.initial(B), []
        for t in range(5):
            decision, state = policy(world_of(privileged, seed=t), state)
            decisions.append(decision)
        runs.append((stack(decisions), state))
    (first, first_state), (second, second_state) = runs
    for name in first:
        assert torch.equal(first[name], second[name]), name
    assert torch.equal(first_state.cell, second_state.cell)
    assert len(first.actions.unique()) == 3


def test_actor_gradient_does_not_reach_critic():
    policy = policy_of()
    decision, _ = policy(world_of(values_of(PRIVILEGED, B)), policy.initial(B))
    decision.logprobs.sum().backward()
    with_grad = {name.split(".")[0] for name, p in policy.named_parameters() if p.grad is not None}
    assert with_grad == {"intake", "core", "output"}


def test_policy_without_critic_acts_the_same():
    trained, actor = policy_of("asymmetric", seed=1), policy_of(None, seed=2)
    weights = trained.state_dict()
    actor.load_state_dict({name: weights[name] for name in actor.state_dict()})
    assert not any(name.startswith(("critic", "prediction")) for name in actor.state_dict())
    expected, _ = trained(world_of(values_of(PRIVILEGED, B)), trained.initial(B), sample=False)
    decision, _ = actor(world_of(), actor.initial(B), sample=False)
    assert torch.equal(decision.actions, expected.actions)
    assert torch.equal(decision.logits, expected.logits)


@pytest.mark.parametrize("critic", ["asymmetric", "plain", None])
def test_initial_actor_weights_do_not_depend_on_critic(critic):
    weights, expected = policy_of(critic).state_dict(), policy_of("asymmetric").state_dict()
    names = [name for name in weights if not name.startswith(("critic", "prediction"))]
    assert names and all(torch.equal(weights[name], expected[name]) for name in names)


# ---- The value ----


def test_only_asymmetric_critic_sees_privileged():
    features = torch.randn(T, B, WIDTH)
    one, other = values_of(PRIVILEGED, T, B, seed=1), values_of(PRIVILEGED, T, B, seed=2)
    policy = policy_of()
    values = [policy.value(features, privileged) for privileged in (one, other)]
    assert values[0].shape == (T, B) and not (values[0] == values[1]).any()
    plain = policy_of("plain")
    values = [plain.value(features, privileged) for privileged in (one, one * math.nan, None)]
    assert torch.equal(values[0], values[1]) and torch.equal(values[0], values[2])
    assert plain.privileged_space is None and not hasattr(plain, "prediction")


# ---- The auxiliary prediction ----


def test_prediction_error_trains_features_not_critic():
    policy, privileged = policy_of(), values_of(PRIVILEGED, T, B)
    features = torch.randn(T, B, WIDTH, requires_grad=True)
    error = policy.prediction_error(features, privileged)
    assert error.shape == (T, B)
    error.sum().backward()
    assert features.grad.any()
    with_grad = {name for name, p in policy.named_parameters() if p.grad is not None}
    assert with_grad == {"prediction.weight", "prediction.bias"}


def test_prediction_error_is_in_standard_deviations():
    policy = policy_of()
    privileged = values_of(PRIVILEGED, 500, B, seed=4) * 30 + 7
    for row in range(500):
        policy.update_stats(values_of(OBS, B), privileged[row])
    with torch.no_grad():
        policy.prediction.weight.zero_()
        policy.prediction.bias.zero_()
    # predicting the mean is one standard deviation off
    error = policy.prediction_error(torch.randn(500, B, WIDTH), privileged).mean()
    assert error.item() == pytest.approx(1, abs=0.05)
