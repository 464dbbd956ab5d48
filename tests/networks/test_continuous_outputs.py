"""Outputs of continuous actions, against numerical integrals and torch.distributions."""

import math

import pytest
import torch
from torch import distributions

from megastep import spaces
from megastep.agents.networks import heads
from megastep.agents.networks.heads import CONTINUOUS_OUTPUTS

SPACE = spaces.MultiContinuous(2, 3, (-1.0, 0.0, -5.0), (1.0, 10.0, 2.0))
KINDS = tuple(CONTINUOUS_OUTPUTS)


def make(kind, space=SPACE, scale=3.0):
    """Returns an output with weights of some size, and logits (5, ...)."""
    torch.manual_seed(3)
    output = heads.output(space, 8, continuous=kind)
    with torch.no_grad():
        output.linear.weight.normal_(std=scale / 8**0.5)
        if kind == "gaussian":
            output.log_std.normal_(std=0.5)
    return output, output(torch.randn(5, 8))


@pytest.mark.parametrize("kind", KINDS)
def test_actions_are_within_the_bounds(kind):
    output, logits = make(kind, scale=30.0)
    for actions in output.sample(logits.expand(2000, *logits.shape)), output.greedy(logits):
        assert actions.dtype == torch.float32 and actions.shape[-3:] == (5, 2, 3)
        assert spaces.are_actions(SPACE, actions)
        assert output.logprob(logits, actions).isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_densities_integrate_to_one_and_entropy_is_their_integral(kind):
    space = spaces.MultiContinuous(1, 1, 2.0, 6.0)
    output, logits = make(kind, space)
    edges = torch.linspace(-1, 1, 200_001, dtype=torch.float64)
    x = (edges[1:] + edges[:-1]) / 2
    actions = (4 + 2 * x).float()[:, None, None, None]  # (X, 1, 1, 1): from 2 to 6
    logprobs = output.logprob(logits, actions).double()  # (X, 5), per unit of x
    mass = logprobs.exp() * (edges[1] - edges[0])
    torch.testing.assert_close(mass.sum(0), torch.ones(5).double(), atol=2e-3, rtol=0)
    entropy = -(mass * logprobs).sum(0).float()
    torch.testing.assert_close(output.entropy(logits), entropy, atol=6e-3, rtol=0)
    assert (entropy < math.log(2)).all()  # that of the uniform distribution


@pytest.mark.parametrize("kind", KINDS)
def test_samples_have_the_density(kind):
    output, logits = make(kind, spaces.MultiContinuous(1, 2, -1.0, 3.0), scale=1.0)
    actions = output.sample(logits.expand(100_000, *logits.shape))
    entropy = -output.logprob(logits, actions).mean(0)
    torch.testing.assert_close(entropy, output.entropy(logits), atol=2e-2, rtol=0)
    centre = actions.mean(0) if kind == "beta" else actions.median(0).values
    torch.testing.assert_close(centre, output.greedy(logits), atol=4e-2, rtol=0)


def test_gaussian_is_that_of_torch_distributions():
    output, logits = make("gaussian", spaces.MultiContinuous(1, 3), scale=0.5)
    actions = output.sample(logits)
    mean, log_std = logits.chunk(2, -1)
    squashed = distributions.TransformedDistribution(
        distributions.Normal(mean, log_std.exp()), distributions.TanhTransform()
    )
    torch.testing.assert_close(
        output.logprob(logits, actions),
        squashed.log_prob(actions).sum((-1, -2)),
        atol=1e-3,
        rtol=1e-3,
    )


def test_beta_is_that_of_torch_distributions():
    output, logits = make("beta", spaces.MultiContinuous(1, 3, 0.0, 1.0))
    actions = output.sample(logits)
    beta = distributions.Beta(*logits.chunk(2, -1))
    n = 3 * math.log(2)  # densities are per unit of -1 to 1
    torch.testing.assert_close(
        output.logprob(logits, actions) + n, beta.log_prob(actions).sum((-1, -2))
    )
    torch.testing.assert_close(output.entropy(logits) - n, beta.entropy().sum((-1, -2)))


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_at_the_bounds(kind):
    output, logits = make(kind, scale=30.0)
    logits = logits.detach().requires_grad_()
    low, high = SPACE.tensors()
    for actions in low.expand(5, 2, 3), high.expand(5, 2, 3):
        loss = output.logprob(logits, actions).sum() + output.entropy(logits).sum()
        (grad,) = torch.autograd.grad(loss, logits)
        assert grad.isfinite().all()


def test_standard_deviation_of_a_gaussian_is_about_one_and_bounded_below():
    output = heads.output(SPACE, 8, continuous="gaussian")
    _, log_std = output(torch.randn(5, 8)).chunk(2, -1)
    assert ((0 <= log_std) & (log_std < 0.06)).all()
    with torch.no_grad():
        output.log_std.fill_(-100)
    _, log_std = output(torch.randn(5, 8)).chunk(2, -1)
    torch.testing.assert_close(log_std, torch.full_like(log_std, -3.0))


def test_mixed_spaces_give_mixed_outputs():
    space = {"turn": spaces.MultiDiscrete(1, 3), "push": spaces.MultiContinuous(1, 2)}
    output = heads.output(space, 8)
    logits = output(torch.randn(5, 8))
    actions = output.sample(logits)
    assert spaces.are_actions(space["turn"], actions.turn)
    assert spaces.are_actions(space["push"], actions.push)
    assert output.logprob(logits, actions).shape == output.entropy(logits).shape == (5,)


def test_action_values_of_continuous_actions_are_refused():
    with pytest.raises(ValueError, match="need discrete actions.*learner=ppo"):
        heads.output(SPACE, 8, kind="duelling")
