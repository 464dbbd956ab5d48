"""The duelling output's kernels against PyTorch, on a GPU and on a CPU
(`tests/helpers/cuda_on_cpu.py`).
"""

import pytest
import torch

from megastep import spaces
from megastep.agents.networks import heads
from megastep.agents.networks.kernels import duelling as kernels

# rows, features, agents, choices; from 264 features on, a thread reads several words
CASES = [(7, 8, 1, 8), (300, 256, 1, 7), (129, 264, 2, 3), (257, 64, 8, 1), (130, 520, 2, 4)]


def case(to_gpu, n_rows, width, n_agents, n_choices):
    """Returns a hidden layer after its ReLU, and weights and biases of value and advantages."""
    torch.manual_seed(0)
    hidden = to_gpu(torch.randn(n_rows, 2 * width).relu().bfloat16())
    shapes = (n_agents, width), (n_agents,), (n_agents * n_choices, width), (n_agents * n_choices,)
    return hidden, [to_gpu(torch.randn(shape)).requires_grad_() for shape in shapes]


def plain(hidden, parameters, shape):
    value, advantage = hidden.chunk(2, -1)
    value = torch.nn.functional.linear(value, *parameters[:2])[..., None]
    advantage = torch.nn.functional.linear(advantage, *parameters[2:]).unflatten(-1, shape)
    return value + advantage - advantage.mean(-1, keepdim=True)


@pytest.mark.parametrize("n_rows, width, n_agents, n_choices", CASES)
def test_values_and_gradients_match_plain(to_gpu, n_rows, width, n_agents, n_choices):
    hidden, parameters = case(to_gpu, n_rows, width, n_agents, n_choices)
    shape, weights = (n_agents, n_choices), [p.detach() for p in parameters]
    exact = hidden.float().requires_grad_()
    expected = plain(exact, parameters, shape)
    close = dict(rtol=1e-4, atol=1e-3)  # float32 sums in another order
    torch.testing.assert_close(kernels.values(hidden, weights, shape), expected.detach(), **close)
    d_values = torch.randn_like(expected)
    d_hidden, *gradients = torch.autograd.grad(expected, [exact, *parameters], d_values)
    d_hidden = d_hidden * (hidden > 0)
    fused, (d_bias, *others) = kernels.backward(hidden, weights[0], weights[2], d_values)
    torch.testing.assert_close(fused.float(), d_hidden, rtol=1e-2, atol=1e-3)  # 8 bits
    torch.testing.assert_close(d_bias, d_hidden.sum(0), **close)
    for i, (one, other) in enumerate(zip(others, gradients, strict=True)):
        torch.testing.assert_close(one, other, msg=lambda text, i=i: f"{i}: {text}", **close)


@pytest.mark.parametrize("n_rows, width, n_agents, n_choices", CASES)
def test_acting_matches_plain(to_gpu, n_rows, width, n_agents, n_choices):
    hidden, parameters = case(to_gpu, n_rows, width, n_agents, n_choices)
    shape, weights = (n_agents, n_choices), [p.detach() for p in parameters]
    noise = to_gpu(torch.rand(2, n_rows, n_agents))
    epsilon = to_gpu(torch.rand(n_rows))
    values, actions, logprobs = kernels.act(hidden, weights, shape, noise, epsilon, 0.05)
    assert torch.equal(values, kernels.values(hidden, weights, shape))
    best, random = values.argmax(-1), (noise[0] * n_choices).long()
    assert torch.equal(actions, torch.where(noise[1] < epsilon[:, None], random, best))
    expected = (0.95 * (actions == best) + 0.05 / n_choices).log().sum(-1)
    torch.testing.assert_close(logprobs, expected, rtol=1e-5, atol=1e-5)
    greedy = kernels.act(hidden, weights, shape, None, None, 0.05)[1]
    assert torch.equal(greedy, best)


@pytest.mark.cuda
def test_output_matches_float32():
    torch.manual_seed(0)
    output = heads.output(spaces.MultiDiscrete(2, 3), 64, "duelling").cuda()
    x = torch.randn(5, 40, 64, device="cuda", requires_grad=True)
    results = []
    for enabled in (False, True):
        with torch.autocast("cuda", torch.bfloat16, enabled=enabled):
            values = output(x)
        inputs = [x, *output.parameters()]
        results.append([values, *torch.autograd.grad(values.square().sum(), inputs)])
    for i, (one, other) in enumerate(zip(*results, strict=True)):
        # 8 bits; a ReLU's input near 0 may change its sign
        error = (one - other).norm() / one.norm()
        assert other.shape == one.shape and error < 0.1, (i, error)


@pytest.mark.cuda
def test_output_draws_the_same_actions_fused_or_not():
    output = heads.output(spaces.MultiDiscrete(1, 4), 64, "duelling").cuda()
    x, epsilon = torch.randn(4000, 64, device="cuda"), torch.rand(4000, device="cuda")
    generator = torch.Generator("cuda")
    with torch.no_grad(), torch.autocast("cuda", torch.bfloat16):
        logits, fused, _ = output.act(x, True, generator.manual_seed(3), epsilon=epsilon)
        plain = output.sample(logits, generator.manual_seed(3), epsilon=epsilon)
    assert torch.equal(fused, plain)
