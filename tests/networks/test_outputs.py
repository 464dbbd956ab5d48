"""Outputs made from spaces, distributions of actions, and their kernels against PyTorch."""

import math

import pytest
import torch
from torch import nn

from megastep import spaces
from megastep.agents.networks import duelling_output, heads
from megastep.agents.networks import linear as linear_module
from megastep.agents.networks.fused import plain_operations
from megastep.arrdict import arrdict
from tests.helpers.weights import moved

IMAGE, VECTOR = spaces.MultiImage(2, 3, 1, 16), spaces.MultiVector(2, 5)
MOVES = arrdict(movement=spaces.MultiDiscrete(2, 7), fire=spaces.MultiDiscrete(2, 2))
WIDTH = 24


def test_key_that_modules_use_is_refused():
    with pytest.raises(ValueError, match="^an action space cannot have the key 'type',.*type_$"):
        heads.output(arrdict(type=spaces.MultiDiscrete(1, 2)), WIDTH)


def test_shapes_of_logits_and_actions():
    output = heads.output(MOVES, WIDTH)
    logits = output(torch.randn(6, WIDTH))
    assert logits.movement.shape == (6, 2, 7) and logits.fire.shape == (6, 2, 2)
    torch.testing.assert_close(logits.movement.exp().sum(-1), torch.ones(6, 2))
    actions = output.sample(logits)
    assert actions.movement.shape == actions.fire.shape == (6, 2)
    assert actions.fire.dtype == torch.int64
    assert output.logprob(logits, actions).shape == output.entropy(logits).shape == (6,)


def test_logprob_and_entropy_match_hand_calculation():
    output = heads.output(MOVES, WIDTH)
    even = arrdict(
        movement=torch.full((1, 2, 7), 1 / 7).log(),
        fire=torch.tensor([[[0.25, 0.75], [0.5, 0.5]]]).log(),
    )
    actions = arrdict(movement=torch.tensor([[6, 0]]), fire=torch.tensor([[1, 0]]))
    # two agents move uniformly among 7; one fires with probability 3/4, the other with 1/2
    assert output.logprob(even, actions).item() == pytest.approx(
        2 * math.log(1 / 7) + math.log(0.75) + math.log(0.5)
    )
    uneven = -0.25 * math.log(0.25) - 0.75 * math.log(0.75)
    assert output.entropy(even).item() == pytest.approx(2 * math.log(7) + uneven + math.log(2))
    assert output.greedy(even).fire.tolist() == [[1, 0]]


def test_initial_policy_is_almost_uniform():
    output = heads.output(spaces.MultiDiscrete(1, 7), WIDTH)
    assert output.entropy(output(torch.randn(100, WIDTH))).min().item() == pytest.approx(
        math.log(7), abs=0.01
    )


def test_sample_frequencies_match_probabilities():
    probabilities = torch.tensor([0.5, 0.3, 0.15, 0.05])
    output, n = heads.output(spaces.MultiDiscrete(1, 4), WIDTH), 100_000
    logits = probabilities.log().expand(n, 1, 4)
    sampled = (
        output.sample(logits, torch.Generator().manual_seed(0)).flatten().bincount(minlength=4) / n
    )
    error = (probabilities * (1 - probabilities) / n).sqrt()
    assert ((sampled - probabilities).abs() < 4 * error).all()


def test_duelling_is_value_plus_centred_advantages():
    output = heads.output(spaces.MultiDiscrete(2, 3), WIDTH, "duelling")
    x = torch.randn(5, WIDTH)
    hidden = output.hidden(x).relu()
    value = hidden[:, :WIDTH] @ output.value.weight.T + output.value.bias
    q = output(x)
    torch.testing.assert_close(q.mean(-1), value)
    advantage = (hidden[:, WIDTH:] @ output.advantage.weight.T).view(5, 2, 3)
    torch.testing.assert_close(q.diff(dim=-1), advantage.diff(dim=-1))


def test_joint_action_value_is_sum():
    output = heads.output(MOVES, WIDTH, "duelling")
    logits = output(torch.randn(4, 6, WIDTH))
    actions = output.greedy(logits)
    best = sum(logits[key].amax(-1).sum(-1) for key in logits)
    torch.testing.assert_close(output.action_value(logits, actions), best)
    other = arrdict(actions, fire=1 - actions.fire)
    loss = logits.fire.diff(dim=-1).abs().sum((-1, -2))
    torch.testing.assert_close(output.action_value(logits, other), best - loss)


def test_duelling_sample_is_epsilon_greedy():
    n = 100_000
    output = heads.output(spaces.MultiDiscrete(1, 4), WIDTH, "duelling")
    logits = torch.tensor([0.1, 0.9, 0.3, -2.0]).expand(n, 1, 4)
    epsilon = torch.tensor([0.0, 0.5]).repeat_interleave(n // 2)
    generator = torch.Generator().manual_seed(0)
    actions = output.sample(logits, generator, epsilon=epsilon)
    assert (actions[: n // 2] == 1).all()
    shares = actions[n // 2 :].flatten().bincount(minlength=4) / (n / 2)
    expected = torch.tensor([0.125, 0.625, 0.125, 0.125])
    torch.testing.assert_close(shares, expected, rtol=0, atol=0.008)  # 4 standard errors
    shares = output.sample(logits, generator).flatten().bincount(minlength=4) / n
    likely = output.logprob(logits[:4], torch.arange(4)[:, None]).exp()
    torch.testing.assert_close(likely, torch.tensor([0.0125, 0.9625, 0.0125, 0.0125]))
    torch.testing.assert_close(shares, likely, rtol=0, atol=0.0025)


def test_action_values_are_float32_under_autocast():
    output = heads.output(spaces.MultiDiscrete(1, 4), WIDTH, "duelling")
    with torch.no_grad():
        output.value.bias += 300.0
        with torch.autocast("cpu", torch.bfloat16):
            values = output(torch.randn(50, WIDTH))
    assert values.dtype == torch.float32
    # near 300, bfloat16 numbers are 2 apart
    assert 0.01 < values.std() < 1 and len(values.mean(-1).unique()) > 40


def test_zero_features_have_a_gradient():
    output = heads.output(spaces.MultiDiscrete(1, 4), WIDTH, "duelling")
    x = torch.zeros(1, WIDTH, requires_grad=True)
    output(x)[0, 0, 1].backward()
    assert x.grad.abs().sum() > 0


@pytest.mark.parametrize(
    "make, error",
    [
        (lambda: heads.intake("images", WIDTH), "observation space itself = 'images'"),
        (lambda: heads.intake(arrdict(imu=VECTOR, x=3), WIDTH), "observation space x = 3"),
        (lambda: heads.intake(arrdict(nothing=spaces.MultiEmpty()), WIDTH), "nothing in it"),
        (lambda: heads.intake(IMAGE, WIDTH, "resnet"), "'resnet'.*cnn, conv, linear, module:Class"),
        (lambda: heads.output(VECTOR, WIDTH), "MultiContinuous or dicts of them"),
        (lambda: heads.output(arrdict(), WIDTH), "MultiContinuous or dicts of them"),
    ],
)
def test_unknown_spaces_raise(make, error):
    with pytest.raises(ValueError, match=error):
        make()


# ---- On a GPU ----


@pytest.mark.parametrize("n_lanes, shape", [(1, (1, 7)), (37, (3, 2)), (70, (1, 8))])
def test_actions_are_those_of_the_plain_form(to_gpu, n_lanes, shape):
    torch.manual_seed(0)
    output = heads.output(spaces.MultiDiscrete(*shape), 64)
    nn.init.normal_(output.linear.weight, std=0.1)
    x = torch.randn(n_lanes, 64)
    on_gpu = to_gpu(x)
    generator = torch.Generator(on_gpu.device)
    output, x = output.to(on_gpu.device), x.to(on_gpu.device)
    for sample in (True, False):
        with torch.no_grad():
            logits, actions, logprobs = output.act(on_gpu, sample, generator.manual_seed(1))
            with plain_operations():
                plain = output.act(x, sample, generator.manual_seed(1))
        torch.testing.assert_close(logits, plain[0], rtol=0, atol=1e-5)
        assert torch.equal(actions, plain[1])
        torch.testing.assert_close(logprobs, plain[2])


# rows, features, agents, choices; from 264 features on, a thread reads several words
CASES = [(7, 8, 1, 8), (300, 256, 1, 7), (129, 264, 2, 3), (257, 64, 8, 1), (130, 520, 2, 4)]
DUELS = pytest.mark.parametrize("n_rows, width, n_agents, n_choices", CASES)


def duel(to_gpu, n_rows, width, n_agents, n_choices):
    """Returns an output whose values and advantages are large, and features."""
    torch.manual_seed(0)
    output = heads.output(spaces.MultiDiscrete(n_agents, n_choices), width, "duelling")
    for name, leaf in output.named_parameters():
        scale = width**-0.5 if name.startswith("hidden") else 1.0
        leaf.data = (scale * torch.randn(leaf.shape)).bfloat16().float()
    return moved(output, to_gpu), to_gpu(torch.randn(n_rows, width).bfloat16()).requires_grad_()


@DUELS
def test_duelling_values_and_gradients_match_plain(
    to_gpu, monkeypatch, n_rows, width, n_agents, n_choices
):
    output, x = duel(to_gpu, n_rows, width, n_agents, n_choices)
    leaves, d_values = [x, *output.parameters()], torch.randn(n_rows, n_agents, n_choices)
    monkeypatch.setattr(linear_module.few_rows, "fits", lambda *matrices: False)
    if not torch.cuda.is_available():  # a CPU's products of bfloat16 have results in bfloat16
        monkeypatch.setattr(
            duelling_output, "gradient_of_weights", lambda d, x: d.float().T @ x.float()
        )
    fused = duelling_output._values_on_gpu(output, x)
    ours = torch.autograd.grad(fused, leaves, to_gpu(d_values))
    with plain_operations():
        plain = output(x.float())
        theirs = torch.autograd.grad(plain, leaves, to_gpu(d_values))
    # the hidden layer and its gradient are rounded to 8 bits
    for i, (one, other) in enumerate(zip([fused, *ours], [plain, *theirs], strict=True)):
        error = (one.float() - other.float()).norm() / other.float().norm().clamp(min=1e-3)
        assert error < 2e-2, (i, error)


@DUELS
def test_duelling_acts_like_plain(to_gpu, monkeypatch, n_rows, width, n_agents, n_choices):
    monkeypatch.setattr(linear_module.few_rows, "fits", lambda *matrices: False)
    output, x = duel(to_gpu, n_rows, width, n_agents, n_choices)
    epsilon, generator = to_gpu(torch.rand(n_rows)), torch.Generator(x.device)
    for sample in (True, False):
        inputs = output, x, sample, generator.manual_seed(1), None, epsilon
        with torch.no_grad(), torch.autocast(x.device.type, torch.bfloat16):
            values, actions, logprobs = duelling_output._act_on_gpu(*inputs)
        generator.manual_seed(1)
        expected = output.greedy(values)
        if sample:
            expected = output.sample(values, generator, epsilon=epsilon)
        assert torch.equal(actions, expected)
        torch.testing.assert_close(logprobs, output.logprob(values, actions), rtol=1e-5, atol=1e-5)
