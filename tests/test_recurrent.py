"""The LSTM against PyTorch's own, and its resets against sequences cut by hand."""

import pytest
import torch
from torch import nn

from agents.recurrent import LSTM
from megastep.arrdict import arrdict

T, B, W = 9, 5, 16
CLOSE = dict(rtol=1e-5, atol=1e-5)  # float32 sums of 16 products, nine steps deep, in another order


def case(seed=0, p_reset=0.3):
    """An LSTM, inputs (T, B, W), resets (T, B), and a state that is not zero."""
    torch.manual_seed(seed)
    lstm = LSTM(W)
    with torch.no_grad():
        lstm.input.bias.normal_()
    x = torch.randn(T, B, W, requires_grad=True)
    state = arrdict({key: torch.randn(B, W, requires_grad=True) for key in ("output", "cell")})
    return lstm, x, torch.rand(T, B) < p_reset, state


def torchs_own(lstm):
    cell = nn.LSTMCell(W, W)
    with torch.no_grad():
        cell.weight_ih.copy_(lstm.input.weight)
        cell.weight_hh.copy_(lstm.memory.weight)
        cell.bias_ih.copy_(lstm.input.bias)
        cell.bias_hh.zero_()
    return cell


def by_hand(cell, x, reset, state):
    """One lane and one step at a time, starting from zeros where an episode starts."""
    outputs, cells = [], []
    for b in range(x.shape[1]):
        h, c = state.output[b], state.cell[b]
        for t in range(len(x)):
            if reset[t, b]:
                h, c = torch.zeros(W), torch.zeros(W)
            h, c = (s[0] for s in cell(x[t, b][None], (h[None], c[None])))
            outputs.append(h)
        cells.append(c)
    return torch.stack(outputs).view(x.shape[1], len(x), W).transpose(0, 1), torch.stack(cells)


@pytest.mark.parametrize("p_reset", [0.0, 0.3, 1.0])
def test_outputs_and_gradients_are_those_of_torchs_own_cell(p_reset):
    lstm, x, reset, state = case(p_reset=p_reset)
    cell = torchs_own(lstm)
    outputs, after = lstm(x, reset, state)
    expected, expected_cell = by_hand(cell, x, reset, state)
    torch.testing.assert_close(outputs, expected, **CLOSE)
    torch.testing.assert_close(after.output, expected[-1], **CLOSE)
    torch.testing.assert_close(after.cell, expected_cell, **CLOSE)

    weights = torch.randn(T, B, W), torch.randn(B, W)
    of = (x, state.output, state.cell)
    ours = torch.autograd.grad(
        (outputs * weights[0]).sum() + (after.cell * weights[1]).sum(),
        (*of, lstm.input.weight, lstm.memory.weight, lstm.input.bias),
    )
    theirs = torch.autograd.grad(
        (expected * weights[0]).sum() + (expected_cell * weights[1]).sum(),
        (*of, cell.weight_ih, cell.weight_hh, cell.bias_ih),
        materialize_grads=True,
    )
    for name, a, b in zip(
        ("x", "output", "cell", "input", "memory", "bias"), ours, theirs, strict=True
    ):
        torch.testing.assert_close(
            a, b, rtol=1e-4, atol=1e-4, msg=lambda text, name=name: f"d {name}: {text}"
        )


def test_steps_and_a_sequence_agree():
    lstm, x, reset, state = case()
    outputs, after = lstm(x, reset, state)
    for t in range(T):
        output, state = lstm.step(x[t], reset[t], state)
        torch.testing.assert_close(output, outputs[t], **CLOSE)
    torch.testing.assert_close(state.cell, after.cell, **CLOSE)


def test_a_sequence_may_be_cut_anywhere():
    lstm, x, reset, state = case()
    whole, _ = lstm(x, reset, state)
    first, between = lstm(x[:4], reset[:4], state)
    second, _ = lstm(x[4:], reset[4:], between)
    torch.testing.assert_close(torch.cat([first, second]), whole, **CLOSE)


def test_nothing_before_a_reset_is_remembered_not_even_a_nan():
    lstm, x, _, state = case()
    reset = torch.zeros(T, B, dtype=torch.bool)
    reset[4] = True
    outputs, _ = lstm(x, reset, state)
    corrupted = torch.cat([torch.full((4, B, W), torch.nan), x[4:]])
    again, _ = lstm(corrupted, reset, state.map(lambda leaf: leaf * torch.nan))
    assert torch.equal(again[4:], outputs[4:]) and again[:4].isnan().all()
    (d_x,) = torch.autograd.grad(outputs[4:].sum(), x)
    assert not d_x[:4].any() and d_x[4:].all()


def test_without_a_reset_the_first_input_reaches_the_last_output():
    lstm, x, _, state = case()
    (d_x,) = torch.autograd.grad(
        lstm(x, torch.zeros(T, B, dtype=torch.bool), state)[0][-1].sum(), x
    )
    assert d_x[0].all()


def test_lanes_do_not_mix():
    lstm, x, reset, state = case()
    (d_x,) = torch.autograd.grad(lstm(x, reset, state)[0][:, 2].sum(), x)
    assert d_x[-1, 2].all() and not d_x[:, [0, 1, 3, 4]].any()


def test_forget_gates_start_open_and_no_other_gate():
    # Jozefowicz et al. 2015: a bias of 1; in the order of torch.nn.LSTM, forget is the second of
    # four. With no input and no output yet, a cell then retains sigmoid(1) of itself per step.
    lstm = LSTM(W)
    biases = lstm.input.bias.detach().split(W)
    assert [bias.unique().tolist() for bias in biases] == [[0.0], [1.0], [0.0], [0.0]]
    state = arrdict(output=torch.zeros(B, W), cell=torch.ones(B, W))
    _, after = lstm.step(torch.zeros(B, W), torch.zeros(B, dtype=torch.bool), state)
    retained = torch.sigmoid(torch.tensor(1.0)).item()
    torch.testing.assert_close(after.cell, torch.full((B, W), retained), **CLOSE)


@pytest.mark.cuda
def test_the_fused_cell_agrees_with_the_written_out_one():
    lstm, x, reset, state = case()
    on_gpu = LSTM(W).cuda()
    on_gpu.load_state_dict(lstm.state_dict())
    results = []
    for module, device in ((lstm, "cpu"), (on_gpu, "cuda")):
        inputs = [
            leaf.detach().to(device).requires_grad_() for leaf in (x, state.output, state.cell)
        ]
        outputs, after = module(
            inputs[0], reset.to(device), arrdict(output=inputs[1], cell=inputs[2])
        )
        loss = outputs.square().sum() + after.cell.sum()
        grads = torch.autograd.grad(loss, [*inputs, *module.parameters()])
        results.append([leaf.cpu() for leaf in (outputs, after.cell, *grads)])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(
            theirs, ours, rtol=1e-3, atol=1e-3
        )  # products may round to TF32 on a GPU
