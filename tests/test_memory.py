"""Recurrent cores, each held to the same: resets clear them, and stepping is unrolling."""

import pytest
import torch
from torch import nn

from agents.memory import GRU, MEMORIES, memory

T, B, W = 9, 5, 8
CLOSE = dict(rtol=1e-5, atol=1e-5)  # float32 sums of 8 products, nine steps deep, in another order


def case(name, seed=0, p_reset=0.3):
    """A core, inputs (T, B, W), resets (T, B), and a state that is not zero."""
    torch.manual_seed(seed)
    core = memory(name, W)
    state = core.initial(B).map(torch.randn_like)
    return core, torch.randn(T, B, W), torch.rand(T, B) < p_reset, state


@pytest.mark.parametrize("name", MEMORIES)
def test_an_episode_is_the_same_wherever_it_is_spliced_in(name):
    core, x, _, state = case(name)
    alone, after = core(x, torch.zeros(T, B, dtype=torch.bool), core.initial(B))
    for start in range(4):
        reset = torch.zeros(start + T, B, dtype=torch.bool)
        reset[start] = True
        before = torch.full((start, B, W), torch.nan)
        outputs, state_after = core(torch.cat([before, x]), reset, state)
        torch.testing.assert_close(outputs[start:], alone, **CLOSE)
        for key, leaf in after.items():
            torch.testing.assert_close(state_after[key], leaf, **CLOSE)


@pytest.mark.parametrize("name", MEMORIES)
def test_no_gradient_passes_a_reset(name):
    core, x, _, state = case(name)
    x.requires_grad_()
    reset = torch.zeros(T, B, dtype=torch.bool)
    reset[4, :2] = True
    outputs, _ = core(x, reset, state)
    (d_x,) = torch.autograd.grad(outputs[4:].sum(), x)
    assert not d_x[:4, :2].any() and d_x[4:].any()
    assert bool(d_x[:4, 2:].any()) == (name != "none"), "the other lanes remember"


@pytest.mark.parametrize("name", MEMORIES)
def test_unrolling_is_stepping(name):
    core, x, reset, state = case(name)
    outputs, after = core(x, reset, state)
    for t in range(T):
        output, state = core(x[t : t + 1], reset[t : t + 1], state)
        torch.testing.assert_close(output[0], outputs[t], **CLOSE)
    for key in after:
        torch.testing.assert_close(state[key], after[key], **CLOSE)


@pytest.mark.parametrize("name", MEMORIES)
def test_lanes_do_not_mix(name):
    core, x, reset, state = case(name)
    outputs, _ = core(x, reset, state)
    one, _ = core(x[:, 2:3], reset[:, 2:3], state.map(lambda leaf: leaf[2:3]))
    torch.testing.assert_close(one[:, 0], outputs[:, 2], **CLOSE)


def test_a_gru_is_torchs_own():
    core, x, _, state = case("gru")
    theirs = nn.GRU(W, W)
    with torch.no_grad():
        core.input.bias.normal_(), core.memory.bias.normal_()
        theirs.weight_ih_l0.copy_(core.input.weight), theirs.bias_ih_l0.copy_(core.input.bias)
        theirs.weight_hh_l0.copy_(core.memory.weight), theirs.bias_hh_l0.copy_(core.memory.bias)
    outputs, after = core(x, torch.zeros(T, B, dtype=torch.bool), state)
    expected, last = theirs(x, state.output[None])
    torch.testing.assert_close(outputs, expected, **CLOSE)
    torch.testing.assert_close(after.output, last[0], **CLOSE)


def test_without_a_memory_there_is_no_state():
    core, x, reset, state = case("none")
    assert not dict(state) and not dict(core(x, reset, state)[1])


def test_an_unknown_core_names_the_nearest():
    with pytest.raises(ValueError, match="'gruu' is unknown; did you mean gru"):
        memory("gruu", W)
    assert isinstance(memory("gru", W), GRU)
