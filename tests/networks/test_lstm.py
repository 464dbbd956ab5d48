"""The LSTM against torch.nn.LSTMCell, and its kernels against PyTorch's operations.

Kernels run on a GPU, and on a CPU from the same source (`tests/helpers/cuda_on_cpu.py`).
"""

import contextlib
import functools

import pytest
import torch
from torch import nn

from megastep import engine
from megastep.agents.networks import lstm as lstm_module
from megastep.agents.networks.fused import aligned, plain_operations
from megastep.agents.networks.lstm import LSTM, WIDTHS
from megastep.arrdict import arrdict
from tests.helpers.recurrent import assert_close

T, B, W = 9, 5, 16
CLOSE = dict(rtol=1e-5, atol=1e-5)  # float32 sums of 16 products, nine steps deep, in another order


def case(seed=0, p_reset=0.3):
    """Returns an LSTM, inputs (T, B, W), resets (T, B) and a nonzero hidden state."""
    torch.manual_seed(seed)
    lstm = LSTM(W)
    with torch.no_grad():
        lstm.input.bias.normal_()
    x = torch.randn(T, B, W, requires_grad=True)
    state = arrdict({key: torch.randn(B, W, requires_grad=True) for key in ("output", "cell")})
    return lstm, x, torch.rand(T, B) < p_reset, state


def torch_cell(lstm):
    """Returns PyTorch's cell with the same weights."""
    cell = nn.LSTMCell(W, W)
    with torch.no_grad():
        cell.weight_ih.copy_(lstm.input.weight)
        cell.weight_hh.copy_(lstm.recurrent.weight)
        cell.bias_ih.copy_(lstm.input.bias)
        cell.bias_hh.zero_()
    return cell


def by_hand(cell, x, reset, state):
    """Runs lane by lane and step by step, from zeros where an episode starts."""
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
@pytest.mark.parametrize("context", [contextlib.nullcontext, plain_operations])
def test_outputs_and_gradients_match_torch(p_reset, context):
    lstm, x, reset, state = case(p_reset=p_reset)
    cell = torch_cell(lstm)
    with context():
        outputs, after = lstm(x, reset, state)
    expected, expected_cell = by_hand(cell, x, reset, state)
    torch.testing.assert_close(outputs, expected, **CLOSE)
    torch.testing.assert_close(after.output, expected[-1], **CLOSE)
    torch.testing.assert_close(after.cell, expected_cell, **CLOSE)

    weights = torch.randn(T, B, W), torch.randn(B, W)
    inputs = (x, state.output, state.cell)
    grads = torch.autograd.grad(
        (outputs * weights[0]).sum() + (after.cell * weights[1]).sum(),
        (*inputs, lstm.input.weight, lstm.recurrent.weight, lstm.input.bias),
    )
    expected_grads = torch.autograd.grad(
        (expected * weights[0]).sum() + (expected_cell * weights[1]).sum(),
        (*inputs, cell.weight_ih, cell.weight_hh, cell.bias_ih),
        materialize_grads=True,
    )
    names = "d x", "d output", "d cell", "d input", "d recurrent", "d bias"
    assert_close(names, grads, expected_grads, 1e-5)


def test_forget_gates_start_open():
    # Jozefowicz et al. 2015: a bias of 1. Forget is the second gate, as in torch.nn.LSTM. Without
    # input and output, a cell then keeps sigmoid(1) of its value per step.
    lstm = LSTM(W)
    biases = lstm.input.bias.detach().split(W)
    assert [bias.unique().tolist() for bias in biases] == [[0.0], [1.0], [0.0], [0.0]]
    state = arrdict(output=torch.zeros(B, W), cell=torch.ones(B, W))
    _, after = lstm(torch.zeros(1, B, W), torch.zeros(1, B, dtype=torch.bool), state)
    retained = torch.sigmoid(torch.tensor(1.0)).item()
    torch.testing.assert_close(after.cell, torch.full((B, W), retained), **CLOSE)


def test_only_a_residual_layer_adds_its_input():
    x, state = torch.randn(3, B, W), [torch.randn(B, W) for _ in range(2)]
    weights = torch.randn(4 * W, W), torch.randn(4 * W), torch.randn(4 * W, W)
    with plain_operations():
        (outputs, last, _), (added, _, _) = (
            lstm_module.lstm_sequence(x, *weights, torch.zeros(3, B).bool(), *state, is_residual)
            for is_residual in (False, True)
        )
    assert torch.equal(last, outputs[-1]) and torch.equal(added, outputs + x)


# ---- The kernels ----


# on a CPU in float32, by clusters in bfloat16
KERNEL = functools.partial(lstm_module._Sequence.apply, True)
PLAIN = lstm_module.lstm_sequence


def sequence(form, device, dtype, x, reset, state, weights, d_outputs, d_cell, residual=False):
    """Returns outputs, last cell and all gradients of the recurrence, as float32 on the CPU."""
    to = [leaf.detach().to(device, dtype).requires_grad_() for leaf in (x, *weights)]
    states = [leaf.detach().to(device).requires_grad_() for leaf in state]
    with plain_operations():
        outputs, last, cell = form(*to, reset.to(device), *states, residual)
    assert residual or torch.equal(last, outputs[-1].float())
    assert outputs.dtype == dtype and cell.dtype == torch.float32
    grads = torch.autograd.grad(
        [outputs, cell], [*to, *states], [d_outputs.to(device, dtype), d_cell.to(device)]
    )
    return [leaf.detach().float().cpu() for leaf in (outputs, cell, *grads)]


NAMES = ("outputs", "cell", "d x", "d input weight", "d bias", "d weight", "d output", "d cell")
# Tolerance as a fraction of a tensor's largest magnitude. float32: approximate exponentials and
# TF32 products. bfloat16: 8 bits, over nine steps.
SLACK = {torch.float32: 2e-3, torch.bfloat16: 6e-2}


@pytest.mark.parametrize("offset", [0, 1])
@pytest.mark.parametrize("shape", [(4, 8), (8, 4)])
def test_aligned_is_contiguous_in_16_byte_words(offset, shape):
    tensor = torch.arange(40.0)[offset : offset + 32].view(shape)
    for source in (tensor, tensor.T):
        copied = aligned(source)
        assert torch.equal(copied, source)
        assert copied.is_contiguous() and not copied.data_ptr() % 16


# ---- A whole sequence in one kernel ----


def whole_sequence(
    form,
    device,
    dtype,
    seed,
    n_steps,
    n_lanes,
    nan_before_reset=False,
    is_residual=False,
    width=256,
):
    """Returns outputs, last cell and gradients of a sequence."""
    torch.manual_seed(seed)
    inputs = dict(
        x=torch.randn(n_steps, n_lanes, width).bfloat16().float(),
        reset=torch.rand(n_steps, n_lanes) < 0.2,
        state=[torch.randn(n_lanes, width).bfloat16().float() for _ in range(2)],
        weights=[
            (torch.randn(shape) / width**0.5).bfloat16().float()
            for shape in ((4 * width, width), (4 * width,), (4 * width, width))
        ],
        d_outputs=torch.randn(n_steps, n_lanes, width).bfloat16().float(),
        d_cell=torch.randn(n_lanes, width),
    )
    if nan_before_reset:
        inputs["reset"][n_steps // 2] = True
        inputs["x"][: n_steps // 2] = torch.nan
    return sequence(form, device, dtype, **inputs, residual=is_residual)


@pytest.mark.parametrize(
    "n_steps, n_lanes, is_residual, width",
    [(2, 1, False, 256), (2, 45, True, 256), (5, 45, True, 128)],
)
def test_sequence_on_chip_matches_float32_in_every_order(
    cuda_on_cpu, monkeypatch, n_steps, n_lanes, is_residual, width
):
    case = 0, n_steps, n_lanes, False, is_residual, width
    expected = whole_sequence(PLAIN, "cpu", torch.float32, *case)
    cuda_on_cpu.install(monkeypatch)
    case = KERNEL, "cpu", torch.bfloat16, *case
    results = cuda_on_cpu.in_every_order(lambda: whole_sequence(*case))
    assert_close(NAMES, results, expected, SLACK[torch.bfloat16])
    names = {f"lstm_sequence_{direction}_{width}" for direction in ("forward", "backward")}
    assert names <= cuda_on_cpu.launched


def test_plain_sequence_in_bfloat16_matches_float32():
    case = 0, 5, 3, False, False, 16
    results = whole_sequence(PLAIN, "cpu", torch.bfloat16, *case)
    expected = whole_sequence(PLAIN, "cpu", torch.float32, *case)
    assert_close(NAMES, results, expected, SLACK[torch.bfloat16])


@pytest.mark.cuda
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("n_steps, n_lanes", [(2, 1), (9, 33), (32, 1024), (17, 4100)])
def test_sequence_on_chip_matches_float32_and_is_repeatable(n_steps, n_lanes, width):
    x = torch.empty(n_steps, n_lanes, width, dtype=torch.bfloat16, device="cuda")
    assert lstm_module._fits(x)
    case = 0, n_steps, n_lanes, False, False, width
    first = whole_sequence(KERNEL, "cuda", torch.bfloat16, *case)
    second = whole_sequence(KERNEL, "cuda", torch.bfloat16, *case)
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))
    expected = whole_sequence(PLAIN, "cpu", torch.float32, *case)
    assert_close(NAMES, first, expected, SLACK[torch.bfloat16])
    by_steps = whole_sequence(PLAIN, "cuda", torch.bfloat16, *case)
    assert_close(NAMES, first, by_steps, SLACK[torch.bfloat16])
    first, by_steps = ([leaf.cpu() for leaf in leaves] for leaves in (first, by_steps))
    errors = [
        [((leaf - other).norm() / other.norm()).item() for leaf, other in zip(leaves, expected)]
        for leaves in (first, by_steps)
    ]
    # No less exact than step by step, which rounds more often. One lane is too few to tell
    assert n_lanes == 1 or all(
        one < 1.2 * other + 1e-3 for one, other in zip(*errors, strict=True)
    ), errors


@pytest.mark.cuda
def test_sequence_on_chip_cuts_nan_at_resets():
    n_steps, n_lanes = 8, 50
    outputs, cell, d_x, *_, d_output, d_cell = whole_sequence(
        KERNEL, "cuda", torch.bfloat16, 1, n_steps, n_lanes, nan_before_reset=True
    )
    assert outputs[: n_steps // 2].isnan().any() and outputs[n_steps // 2 :].isfinite().all()
    assert cell.isfinite().all() and d_x[n_steps // 2 :].isfinite().all()


# ---- The kernels of a whole sequence on the CPU ----

# float32 sums in another order, exponentials with an error of 2e-7, up to 32 steps deep
CPU_SLACK = 2e-5


def on_cpu(form, n_steps, n_lanes, width):
    """Returns outputs, last cell and all gradients by the CPU's kernel, or by PyTorch."""
    torch.manual_seed(0)
    weights, recurrent = torch.randn(2, 4 * width, width) / width**0.5
    inputs = dict(
        x=torch.randn(width, n_steps, n_lanes).permute(1, 2, 0),  # not contiguous
        reset=(torch.rand(n_lanes, n_steps) < 0.3).T,
        state=torch.randn(2, n_lanes, width),
        weights=(weights, torch.randn(4 * width), recurrent),
        d_outputs=torch.randn(n_steps, n_lanes, width),
        d_cell=torch.randn(n_lanes, width),
    )
    return sequence(form, "cpu", torch.float32, **inputs)


@pytest.mark.parametrize(
    "shape", [(9, 5, 16), (1, 3, 48), (32, 64, 64), (3, 7, 256), (70, 1, 80)], ids=str
)
def test_cpu_sequence_matches_pytorch(shape):
    expected = on_cpu(PLAIN, *shape)
    assert_close(NAMES, on_cpu(KERNEL, *shape), expected, CPU_SLACK)


def test_cpu_sequence_has_the_same_bits_with_any_number_of_threads():
    results = []
    for n_threads in (1, 2, 3):
        engine.set_threads(n_threads)
        results.append(on_cpu(KERNEL, 32, 65, 64))
    engine.set_threads(None)
    for other in results[1:]:
        assert all(map(torch.equal, results[0], other))


def test_widths_that_kernels_do_not_take_use_pytorch():
    lstm = LSTM(17)
    output, _ = lstm(torch.zeros(1, 1, 17), torch.zeros(1, 1, dtype=bool), lstm.initial(1))
    assert output.isfinite().all()
