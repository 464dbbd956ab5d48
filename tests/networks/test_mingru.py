"""The minGRU against its equations step by step, and its kernels against the CPU implementation.

Kernels run on a GPU, and on a CPU from the same source (`tests/helpers/cuda_on_cpu.py`).
"""

import pytest
import torch

from megastep.agents.networks import mingru as mingru_module
from megastep.agents.networks.fused import plain_operations
from megastep.agents.networks.linear import linear_scan
from megastep.agents.networks.mingru import MinGRU
from megastep.arrdict import arrdict
from tests.helpers.recurrent import assert_close

T, B, W = 9, 5, 16


def case(n_steps=T, p_reset=0.3):
    """Returns gates (T, B, 2 W), resets (T, B) and a nonzero state."""
    torch.manual_seed(0)
    gates = torch.randn(n_steps, B, 2 * W, requires_grad=True)
    return gates, torch.rand(n_steps, B) < p_reset, torch.randn(B, W, requires_grad=True)


def recurrence(gates, reset, start, d_outputs, d_last=None, residual=None, on_gpu=False):
    """Returns outputs, the last state, and gradients of the gates, of the first state and of the
    biases.
    """
    forward, backward = mingru_module.recurrence, mingru_module.recurrence_backward
    if on_gpu:
        forward, backward = mingru_module._forward_on_gpu, mingru_module._backward_on_gpu
    outputs, last, states = forward(gates, reset, start, residual, residual is not None)
    if residual is not None:  # as when acting: without states
        alone = forward(gates, reset, start, residual)
        for result, expected in zip(alone, (outputs, last, None), strict=True):
            torch.testing.assert_close(result, expected, rtol=0, atol=0, equal_nan=True)
    states = outputs if states is None else states
    d_gates, d_bias, d_start, d_residual = backward(
        gates, reset, start, states, d_outputs, d_last, residual is not None
    )
    assert residual is None or torch.equal(d_residual, d_outputs)
    return outputs, last, d_gates, d_start, d_bias


def by_hand(gates, reset, start):
    """Runs lane by lane and step by step, from zeros where an episode starts."""
    lanes, lasts = [], []
    for b in range(gates.shape[1]):
        h, states = start[b], []
        for t in range(len(gates)):
            if reset[t, b]:
                h = torch.zeros(W)
            z = 1 / (1 + (-gates[t, b, :W]).exp())
            h = (1 - z) * h + z * gates[t, b, W:]
            states.append(h)
        lanes.append(torch.stack(states))
        lasts.append(h)
    return torch.stack(lanes, 1), torch.stack(lasts)


@pytest.mark.parametrize("n_steps, p_reset", [(1, 0.3), (9, 0.0), (9, 0.3), (9, 1.0), (32, 0.1)])
def test_outputs_and_gradients_match_equations(n_steps, p_reset):
    gates, reset, start = case(n_steps, p_reset)
    expected = by_hand(gates, reset, start)
    weights = torch.randn(n_steps, B, W), torch.randn(B, W)
    d_gates, d_start = torch.autograd.grad(
        expected, (gates, start), weights, materialize_grads=True
    )
    expected = *expected, d_gates, d_start, d_gates.sum((0, 1))
    with torch.no_grad():
        results = recurrence(gates, reset, start, *weights)
    assert_close(NAMES, results, expected, 1e-5)  # float32 sums of nine terms in another order


# ---- The scan ----

F64_CLOSE = dict(rtol=1e-10, atol=1e-10)  # two orders of summing a few float64 numbers


def sums_by_steps(terms, factors, reset):
    sums, last = [], torch.zeros_like(terms[0])
    for term, factor, is_reset in zip(terms, factors, reset, strict=True):
        last = torch.where(is_reset, term, term + factor * last)
        sums.append(last)
    return torch.stack(sums)


@pytest.mark.parametrize("n_steps", [1, 2, 3, 8, 13, 32])
def test_scan_matches_recursion_in_both_directions(n_steps):
    torch.manual_seed(n_steps)
    terms, factors = torch.randn(2, n_steps, 5, 3, dtype=torch.float64)
    reset = torch.rand(n_steps, 5, 1) < 0.2
    expected = sums_by_steps(terms, factors, reset)
    torch.testing.assert_close(linear_scan(terms, factors, reset), expected, **F64_CLOSE)
    backwards = sums_by_steps(terms.flip(0), factors.flip(0), reset.flip(0)).flip(0)
    torch.testing.assert_close(
        linear_scan(terms, factors, reset, reverse=True), backwards, **F64_CLOSE
    )
    unbroken = sums_by_steps(terms, factors, torch.zeros(n_steps, 1, 1, dtype=torch.bool))
    torch.testing.assert_close(linear_scan(terms, factors), unbroken, **F64_CLOSE)


# ---- The kernels ----


@pytest.fixture(params=["compiled", pytest.param("cuda", marks=pytest.mark.cuda)])
def where(request, monkeypatch):
    """Device of the kernels: a GPU, or the CPU with kernels compiled for it."""
    if request.param == "cuda":
        return "cuda"
    request.getfixturevalue("cuda_on_cpu").install(monkeypatch)
    return "cpu"


def sequence(on_gpu, device, dtype, gates, reset, start, d_outputs, d_last, residual=None):
    """Returns what `recurrence` does, as float32 on the CPU."""
    gates, d_outputs = (leaf.to(device, dtype).contiguous() for leaf in (gates, d_outputs))
    residual = None if residual is None else residual.to(device, dtype).contiguous()
    reset, start = (leaf.to(device).contiguous() for leaf in (reset, start))
    d_last = None if d_last is None else d_last.to(device).contiguous()
    results = recurrence(gates, reset, start, d_outputs, d_last, residual, on_gpu)
    assert results[1].dtype == results[-1].dtype == torch.float32
    return [leaf.float().cpu() for leaf in results]


NAMES = ("outputs", "last", "d gates", "d start", "d bias")
# Tolerance as a fraction of a tensor's largest magnitude. float32: approximate exponentials.
# bfloat16: 8 bits.
SLACK = {torch.float32: 1e-5, torch.bfloat16: 1e-2}


@pytest.mark.parametrize("dtype", SLACK, ids=str)
@pytest.mark.parametrize("is_residual", [False, True])
@pytest.mark.parametrize(
    "n_steps, n_lanes, width",
    [
        *((9, 5, 16), (9, 5, 7), (1, 3, 16), (2, 3, 5), (4, 3, 8), (9, 1, 1), (3, 40, 256)),
        # blocks of several lanes, the last one not full; lanes of several blocks
        *((3, 601, 16), (3, 257, 7), (2, 1100, 128), (1, 6600, 20), (2, 3, 1028)),
    ],
)
def test_kernels_match_cpu(where, dtype, n_steps, n_lanes, width, is_residual):
    torch.manual_seed(0)

    def rounded(*shape):
        """Returns numbers rounded to bfloat16, so that both start with the same."""
        return torch.randn(*shape).bfloat16().float()

    inputs = dict(
        gates=rounded(n_steps, n_lanes, 2 * width),
        reset=torch.rand(n_steps, n_lanes) < 0.3,
        start=torch.randn(n_lanes, width),
        d_outputs=rounded(n_steps, n_lanes, width),
        d_last=None if is_residual else torch.randn(n_lanes, width),
        residual=rounded(n_steps, n_lanes, width) if is_residual else None,
    )
    results = sequence(True, where, dtype, **inputs)
    expected = sequence(False, "cpu", torch.float32, **inputs)
    assert_close(NAMES, results, expected, SLACK[dtype])


@pytest.mark.parametrize("dtype", SLACK, ids=str)
@pytest.mark.parametrize("width", [16, 7])
def test_kernels_clear_even_nan_at_reset(where, dtype, width):
    torch.manual_seed(0)
    inputs = dict(
        gates=torch.randn(T, B, 2 * width),
        reset=torch.zeros(T, B, dtype=torch.bool),
        start=torch.randn(B, width),
        d_outputs=torch.randn(T, B, width),
        d_last=torch.randn(B, width),
    )
    inputs["reset"][[0, 4]] = True
    clean = sequence(True, where, dtype, **inputs)
    broken = dict(inputs, gates=inputs["gates"].clone(), start=torch.full((B, width), torch.nan))
    broken["gates"][:4] = torch.nan
    outputs, last, d_gates, d_start, _ = sequence(True, where, dtype, **broken)
    assert torch.equal(outputs[4:], clean[0][4:]) and outputs[:4].isnan().all()
    assert torch.equal(last, clean[1]) and torch.equal(d_gates[4:], clean[2][4:])
    assert not d_start.any()  # cut by the reset
    # a NaN gradient does not pass a reset, either
    inputs["d_outputs"][4:] = torch.nan
    d_gates = sequence(True, where, dtype, **inputs)[2]
    assert torch.equal(d_gates[:4], clean[2][:4]) and d_gates[4:].isnan().all()


@pytest.mark.parametrize("width", [4, 3])
def test_gates_saturate_and_nan_propagates(where, width):
    """All update gates of a lane have the same value before their activation."""
    inf, nan = torch.inf, torch.nan
    values = torch.tensor([-inf, -1e30, -100.0, -20.0, 0.0, 20.0, 100.0, 1e30, inf, nan])
    gates = torch.full((1, len(values), 2 * width), 3.0)
    gates[0, :, :width] = values[:, None]
    start, reset = torch.full((len(values), width), 5.0), torch.zeros(1, len(values)).bool()
    gates, start, reset = (tensor.to(where) for tensor in (gates, start, reset))
    outputs, last, _ = mingru_module._forward_on_gpu(gates, reset, start)
    expected = (5.0 - 2.0 * values.double().sigmoid()).float()[:, None].expand(-1, width)
    for result in (outputs[0], last):
        torch.testing.assert_close(result.cpu(), expected, rtol=0, atol=2e-6, equal_nan=True)


def test_outputs_round_to_nearest_bfloat16(where):
    """Ties to even, as PyTorch rounds. A closed update gate leaves the state as it was."""
    upper = torch.arange(2**16, dtype=torch.int64)[:, None] << 16
    lower = torch.tensor([0, 1, 0x7FFF, 0x8000, 0x8001, 0xFFFF])
    numbers = (upper | lower).flatten().to(torch.int32).view(torch.float32)
    numbers = numbers[numbers.isfinite() & (numbers.abs() >= torch.finfo(torch.float32).tiny)]
    start = numbers[: len(numbers) // 4 * 4].view(-1, 4).to(where)
    gates = torch.zeros(1, len(start), 8, dtype=torch.bfloat16, device=where)
    gates[..., :4] = -torch.inf
    reset = torch.zeros(1, len(start), dtype=torch.bool, device=where)
    outputs, last, _ = mingru_module._forward_on_gpu(gates, reset, start)
    assert torch.equal(last, start)
    assert torch.equal(outputs[0].cpu(), start.cpu().bfloat16())


@pytest.mark.parametrize("is_residual", [False, True])
@pytest.mark.parametrize("is_transposed", [False, True])
@pytest.mark.parametrize("form", ["cpu", "compiled", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_module_matches_its_plain_form(request, monkeypatch, form, is_residual, is_transposed):
    """Whatever the strides of the inputs and of the outputs' gradient."""
    torch.manual_seed(0)
    core, device = MinGRU(W), "cuda" if form == "cuda" else "cpu"
    if form == "compiled":
        request.getfixturevalue("cuda_on_cpu").install(monkeypatch)
        monkeypatch.setattr(mingru_module, "recurrence", mingru_module._forward_on_gpu)
        monkeypatch.setattr(mingru_module, "recurrence_backward", mingru_module._backward_on_gpu)
    x, reset, start = torch.randn(T, B, W), torch.rand(T, B) < 0.3, torch.randn(B, W)
    weights = torch.randn(T, B, W)
    if is_transposed:
        x, weights = (leaf.transpose(0, 2).contiguous().transpose(0, 2) for leaf in (x, weights))
        reset, start = (leaf.T.contiguous().T for leaf in (reset, start))

    def run(device):
        own = MinGRU(W).to(device)
        own.load_state_dict(core.state_dict())
        inputs = [leaf.detach().to(device).requires_grad_() for leaf in (x, start)]
        state = arrdict(output=inputs[1])
        outputs, after = own(inputs[0], reset.to(device), state, is_residual)
        loss = (outputs * weights.to(device)).sum() + after.output.sum()
        gradients = torch.autograd.grad(loss, [*inputs, *own.parameters()])
        results = [leaf.detach().cpu() for leaf in (outputs, after.output, *gradients)]
        with torch.no_grad():
            acted, _ = own(inputs[0], reset.to(device), state, is_residual)
        torch.testing.assert_close(acted.cpu(), results[0], rtol=0, atol=0)
        return results

    results = run(device)
    with plain_operations():
        expected = run("cpu")
    names = "outputs", "last", "d x", "d start", "d weight", "d bias"
    # TF32 rounds products to 11 bits
    assert_close(names, results, expected, 5e-3 if form == "cuda" else 1e-5)
