"""The kernels of one step, the minGRU's and the LSTM's, against twins in float64."""

import pytest
import torch
from torch.nn import functional

from megastep.agents.networks import lstm as lstm_module
from megastep.agents.networks import mingru as mingru_module
from megastep.agents.networks import step as step_module
from megastep.agents.networks.fused import plain_operations
from megastep.agents.networks.step import LSTM, MINGRU, OPERATIONS, step
from tests.helpers.recurrent import assert_close

NAMES = "outputs", "state", "last output"
SLACK = 2e-2  # of the largest number: 8 bits, and approximate exponentials
KINDS = pytest.mark.parametrize("kind", [MINGRU, LSTM], ids=OPERATIONS.get)
RESIDUAL = pytest.mark.parametrize("is_residual", [False, True])


def inputs_of(kind, n_lanes, width, where="cpu"):
    """Returns x, weight, bias, resets, state and, of an LSTM, last output; NaN where reset."""
    torch.manual_seed(0)
    x, n_inner = torch.randn(1, n_lanes, width), (2 if kind is LSTM else 1) * width
    weight = torch.randn(kind * width, n_inner) / width**0.5
    bias, reset = torch.randn(kind * width), torch.rand(1, n_lanes) < 0.3
    state, output = torch.randn(2, n_lanes, width)
    output = output.tanh().bfloat16()
    state[reset[0]] = output[reset[0]] = torch.nan
    parts = *(leaf.bfloat16() for leaf in (x, weight, bias)), reset, state
    parts = (*parts, output) if kind is LSTM else parts
    return [part.to(where) for part in parts]


def taken(kind, inputs, is_residual):
    """Returns what the kernel does."""
    *inputs, output = inputs if kind is LSTM else (*inputs, None)
    return [leaf for leaf in step(kind, *inputs, is_residual, output) if leaf is not None]


def twin(kind, inputs, is_residual):
    x, weight, bias, reset, state, *output = (
        leaf if leaf.dtype == torch.bool else leaf.double() for leaf in inputs
    )
    state, *output = (leaf.masked_fill(reset[0, :, None], 0.0) for leaf in (state, *output))
    gates = functional.linear(torch.cat([x[0], *output], 1), weight, bias)
    if kind is LSTM:
        i, f, g, o = gates.chunk(4, 1)
        state = f.sigmoid() * state + i.sigmoid() * g.tanh()
        outputs = plain = o.sigmoid() * state.tanh()
    else:
        update, candidate = gates.bfloat16().double().chunk(2, 1)
        outputs = state = state.lerp(candidate, update.sigmoid())
        plain = None
    outputs = outputs + x[0] if is_residual else outputs
    return [leaf.float() for leaf in (outputs[None], state, plain) if leaf is not None]


def check(kind, results, inputs, is_residual):
    expected = twin(kind, inputs, is_residual)
    results = [result.float() for result in results]
    assert_close(NAMES[: len(results)], results, expected, SLACK)
    return results, expected


@KINDS
@pytest.mark.parametrize(
    "n_lanes, width, is_residual", [(1, 256, True), (129, 64, False), (37, 192, True)]
)
def test_step_matches_its_twin_in_every_order(
    cuda_on_cpu, monkeypatch, kind, is_residual, n_lanes, width
):
    inputs = inputs_of(kind, n_lanes, width)
    cuda_on_cpu.install(monkeypatch)
    results = cuda_on_cpu.in_every_order(lambda: taken(kind, inputs, is_residual))
    check(kind, results, inputs, is_residual)
    assert cuda_on_cpu.launched == {OPERATIONS[kind]}


@pytest.mark.cuda
@KINDS
@RESIDUAL
@pytest.mark.parametrize(
    "n_lanes, width", [(1, 256), (4096, 256), (5000, 512), (65_536, 64), (200, 128)]
)
def test_step_matches_its_twin_and_is_repeatable(kind, is_residual, n_lanes, width):
    inputs = inputs_of(kind, n_lanes, width, "cuda")
    results, again = (taken(kind, inputs, is_residual) for _ in range(2))
    assert all(map(torch.equal, results, again))
    for result, other in zip(*check(kind, results, inputs, is_residual), strict=True):
        assert (result - other).norm() < 4e-3 * other.norm()  # bfloat16 has 2^-9


@RESIDUAL
@pytest.mark.parametrize("where", ["compiled", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("module", [mingru_module.MinGRU, lstm_module.LSTM])
def test_acting_takes_the_step_and_learning_does_not(
    request, monkeypatch, module, where, is_residual
):
    """Two steps, the second from the state after the first, as a sequence of two."""
    torch.manual_seed(0)
    calls, device = [], "cuda" if where == "cuda" else "cpu"
    if where == "compiled":
        emulator = request.getfixturevalue("cuda_on_cpu")
        emulator.install(monkeypatch)
        fits = step_module._fits

        def fits_on_cpu(kind, x, dtype):
            return fits(kind, emulator.tensor(x), dtype)

        monkeypatch.setattr(step_module, "fits", fits_on_cpu)
        monkeypatch.setattr(step_module, "has_hopper", lambda *_: True)
    monkeypatch.setattr(step_module, "step", lambda *a: calls.append(a) or step(*a))
    core = module(64).to(device)
    x, reset = torch.randn(2, 5, 64, device=device), torch.rand(2, 5, device=device) < 0.5
    state = core.initial(5, device).map(torch.randn_like)
    state["output"] = state["output"].bfloat16().float()
    with plain_operations():
        expected, after = core(x, reset, state, is_residual)
    outputs, now = [], state
    with torch.autocast(device, torch.bfloat16):
        core(x[:1].bfloat16(), reset[:1], state, is_residual)  # with a gradient
        assert not calls
        with torch.no_grad():
            for t in range(2):
                output, now = core(x[t : t + 1].bfloat16(), reset[t : t + 1], now, is_residual)
                outputs.append(output)
    assert len(calls) == 2
    results = [torch.cat(outputs), *(now[key] for key in after)]
    names, expected = ("outputs", *after), [expected, *after.values()]
    assert_close(names, [leaf.float() for leaf in results], expected, 2 * SLACK)
