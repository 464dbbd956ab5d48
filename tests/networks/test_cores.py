"""The contract of recurrent cores, for every built-in one: resets clear them, and steps match an
unroll. On a GPU in bfloat16, as policies use them.
"""

import pytest
import torch
from torch import nn

from megastep.agents.networks.cores import CORES, make_core, with_residual
from megastep.agents.networks.plain_cores import GRU
from megastep.arrdict import arrdict
from megastep.dotdict import leaves
from tests.helpers.recurrent import assert_close as assert_close_by_size

T, B, W = 9, 5, 16  # a width that the LSTM's kernels on a CPU take
# CPU: float32 sums of 16 products in another order, nine steps deep. GPU: bfloat16's rounding,
# which accumulates through layers and steps.
CLOSE = {"cpu": dict(rtol=1e-5, atol=1e-5), "cuda": dict(rtol=0, atol=5e-2)}

each_core = pytest.mark.parametrize("name", CORES)
each_depth = pytest.mark.parametrize("layers", [1, 2])


def case(name, layers, device="cpu", n_steps=T, width=W):
    """Returns a core, inputs (T, B, W), resets (T, B) and a nonzero hidden state."""
    torch.manual_seed(0)
    core = make_core(name, width, layers)
    state = core.initial(B).map(torch.randn_like)
    x, reset = torch.randn(n_steps, B, width), torch.rand(n_steps, B) < 0.3
    return core.to(device), x.to(device), reset.to(device), state.map(lambda s: s.to(device))


def test_activation_is_of_the_core_none():
    core = make_core("none", W, activation="tanh")
    x, reset = 1e3 * torch.randn(T, B, W), torch.zeros(T, B, dtype=torch.bool)
    assert core(x, reset, core.initial(B))[0].abs().max() <= 1
    assert isinstance(make_core("gru", W, activation="tanh"), GRU)


def run(core, x, reset, state):
    """Calls a core like a policy does; outputs are converted to float32."""
    with torch.autocast(x.device.type, torch.bfloat16, enabled=x.is_cuda):
        outputs, after = core(x, reset, state)
    return outputs.float(), after


def assert_close(tree, expected, device):
    for leaf, expected_leaf in zip(leaves(tree), leaves(expected), strict=True):
        torch.testing.assert_close(leaf, expected_leaf, **CLOSE[device])


@each_depth
@each_core
def test_episodes_in_one_lane_match_episodes_alone(name, layers, device):
    """Every lane holds consecutive episodes of 1 to 7 steps, which start at different times."""
    n_steps = 30
    core, _, _, dirty = case(name, layers, device)
    lengths = torch.randint(1, 8, (B, n_steps), generator=torch.Generator().manual_seed(1))
    expected = torch.empty(n_steps, B, W, device=device)
    x, reset = torch.randn_like(expected), torch.zeros(n_steps, B, dtype=torch.bool, device=device)
    last = []
    for b in range(B):
        ends = lengths[b].cumsum(0)
        for start, end in zip([0, *ends.tolist()], ends.tolist(), strict=False):
            if start < n_steps:
                reset[start, b] = True
                episode = x[start:end, b : b + 1]
                alone = torch.zeros(len(episode), 1, dtype=torch.bool, device=device)
                outputs, after = run(core, episode, alone, core.initial(1, device))
                expected[start:end, b] = outputs[:, 0]
        last.append(after)
    assert reset[1:].any(0).all() and reset.sum(0).unique().numel() > 1
    outputs, after = run(core, x, reset, dirty)
    assert_close(outputs, expected, device)
    for leaf, *alone in zip(leaves(after), *map(leaves, last), strict=True):
        assert_close(leaf, torch.cat(alone), device)


@each_depth
@each_core
@pytest.mark.parametrize("p_reset", [0.2, 1.0])
def test_reset_clears_hidden_state_bit_for_bit(name, layers, device, p_reset):
    core, x, reset, state = case(name, layers, device, n_steps=16)
    generator = torch.Generator().manual_seed(2)
    reset = (torch.rand(16, B, generator=generator) < p_reset).to(device)
    reset[7] = True
    outputs, after = run(core, x, reset, state)
    for scale in (1e3, torch.nan):
        other = x.clone()
        other[:7] = scale * torch.randn(7, B, W, generator=generator).to(device)
        other_outputs, after_other = run(core, other, reset, state * scale)
        assert torch.equal(other_outputs[7:], outputs[7:])
        assert not torch.equal(other_outputs[:7], outputs[:7])
        for a, b in zip(leaves(after_other), leaves(after), strict=True):
            assert torch.equal(a, b)


@each_depth
@each_core
def test_gradients_stop_at_reset(name, layers, device):
    core, x, _, state = case(name, layers, device)
    inputs = [x.requires_grad_(), *(leaf.requires_grad_() for leaf in leaves(state))]
    reset = torch.zeros(T, B, dtype=torch.bool, device=device)
    reset[4, :2] = True
    outputs, after = run(core, x, reset, state)
    loss = outputs[4:].sum() + sum(leaf.sum() for leaf in leaves(after))
    d_x, *d_state = torch.autograd.grad(loss, inputs)
    assert not d_x[:4, :2].any() and d_x[4:].any()
    assert not any(leaf[:2].any() for leaf in d_state)
    assert bool(d_x[:4, 2:].any()) == (name != "none"), "lanes without a reset keep gradients"
    assert all(leaf[2:].any() for leaf in d_state)


@each_depth
@each_core
def test_unroll_matches_steps(name, layers, device):
    core, x, reset, state = case(name, layers, device)
    outputs, after = run(core, x, reset, state)
    for t in range(T):
        output, state = run(core, x[t : t + 1], reset[t : t + 1], state)
        assert_close(output[0], outputs[t], device)
    assert_close(state, after, device)


@each_depth
@each_core
def test_lanes_do_not_mix(name, layers, device):
    core, x, reset, state = case(name, layers, device)
    outputs, _ = run(core, x, reset, state)
    one, _ = run(core, x[:, 2:3], reset[:, 2:3], state.map(lambda leaf: leaf[2:3]))
    assert_close(one[:, 0], outputs[:, 2], device)
    other = x.clone()
    other[:, [0, 1, 3, 4]] = torch.nan
    other_outputs, _ = run(core, other, reset, state)
    assert torch.equal(other_outputs[:, 2], outputs[:, 2])


@each_core
def test_stack_has_residual_connections(name):
    core, x, reset, state = case(name, layers=3)
    features = x
    for i, layer in enumerate(core):
        outputs, after = layer(features, reset, state[str(i)])
        features = features + outputs
    outputs, state = core(x, reset, state)
    torch.testing.assert_close(x + outputs, features, **CLOSE["cpu"])
    assert_close(state["2"], after, "cpu")


@each_depth
@each_core
@pytest.mark.parametrize("width", [W, 7])  # of kernels on a CPU, and of none
def test_residual_connection_around_core(name, layers, device, width):
    """Also its gradients, and in steps without them."""
    core, x, reset, state = case(name, layers, device, width=width)
    x.requires_grad_()
    inputs, weights = [x, *core.parameters()], torch.randn_like(x)
    results = []
    for is_fused in (True, False):
        with torch.autocast(x.device.type, torch.bfloat16, enabled=x.is_cuda):
            if is_fused:
                outputs, after = with_residual(core, x, reset, state)
            else:
                outputs, after = core(x, reset, state)
                outputs = x + outputs
        gradients = torch.autograd.grad((outputs.float() * weights).sum(), inputs)
        results.append([outputs.detach().float(), *leaves(after), *gradients])
    names = [str(i) for i in range(len(results[0]))]
    slack = {"cpu": 1e-5, "cuda": 3e-2}[x.device.type]
    assert_close_by_size(names, *results, slack)
    with torch.no_grad(), torch.autocast(x.device.type, torch.bfloat16, enabled=x.is_cuda):
        for t in range(T):
            output, state = with_residual(core, x[t : t + 1], reset[t : t + 1], state)
            assert_close(output[0].float(), results[0][0][t], device)


@pytest.mark.parametrize("name", ["lstm", "mingru"])
def test_wrong_shapes_raise(name):
    """Kernels would read beyond them."""
    core, x, reset, state = case(name, layers=1)
    with pytest.raises(ValueError, match=r"reset is \(9, 4\) on cpu, but x asks for \(9, 5\) on"):
        core(x, reset[:, :4], state)
    with pytest.raises(ValueError, match=r"state.output is \(1, 16\) on cpu, but .* \(5, 16\)"):
        core(x, reset, arrdict(state, output=state.output[:1]))
    with pytest.raises(ValueError, match=r"x is \(0, 5, 16\), but a sequence has at least one"):
        core(x[:0], reset[:0], state)


def test_gru_matches_torch():
    core, x, _, state = case("gru", layers=1)
    torch_gru = nn.GRU(W, W)
    with torch.no_grad():
        for layer in (core.input, core.recurrent):
            layer.bias.normal_()
        torch_gru.weight_ih_l0.copy_(core.input.weight)
        torch_gru.bias_ih_l0.copy_(core.input.bias)
        torch_gru.weight_hh_l0.copy_(core.recurrent.weight)
        torch_gru.bias_hh_l0.copy_(core.recurrent.bias)
    outputs, after = core(x, torch.zeros(T, B, dtype=torch.bool), state)
    expected, last = torch_gru(x, state.output[None])
    torch.testing.assert_close(outputs, expected, **CLOSE["cpu"])
    torch.testing.assert_close(after.output, last[0], **CLOSE["cpu"])


def test_unknown_core_names_nearest():
    with pytest.raises(ValueError, match="'gruu'.* gru"):
        make_core("gruu", W)
    with pytest.raises(ValueError, match="'mingu'.* mingru"):
        make_core("mingu", W)
    assert isinstance(make_core("gru", W), GRU)


class IgnoresResets(nn.Module):
    """A core that sums its inputs across resets."""

    def __init__(self, width):
        super().__init__()

    def initial(self, n_lanes, device=None):
        return arrdict(total=torch.zeros(n_lanes, 1, device=device))

    def forward(self, x, reset, state):
        totals = state.total + x.cumsum(0)
        return totals, arrdict(total=totals[-1, :, :1])


def test_core_that_ignores_resets_raises():
    for layers in (1, 2):
        with pytest.raises(ValueError, match="reset must clear"):
            make_core("test_cores:IgnoresResets", W, layers)
