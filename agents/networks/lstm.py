"""A long short-term memory (LSTM, Hochreiter and Schmidhuber 1997) whose hidden state is cleared
inside a sequence where an episode starts.

T time, B lanes, W width. Gates are laid out (..., 4 W): input, forget, candidate, output, as in
PyTorch. Matrix products run in the compute dtype (autocast's) on a GPU and in float32 on a CPU. The
cell and its gates are float32 on both: over hundreds of steps a bfloat16 cell would round small
additions away.

The part between two matrix products is written here in PyTorch. On a GPU it is a kernel with the
same arguments (`megastep.agents.networks.kernels.lstm`); acting with few lanes, one kernel has the
product, too (`megastep.agents.networks.kernels.few_rows`). GPUs with clusters of blocks run a
whole sequence, products included, in one kernel (`megastep.agents.networks.kernels.lstm_sequence`),
and so does a CPU if W is a multiple of 16 (`megastep.agents.networks.lstm_cpu`).
"""

from types import SimpleNamespace
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from megastep.agents.networks import products
from megastep.agents.networks.kernels import few_rows, lstm_sequence
from megastep.agents.networks.kernels import lstm as kernels
from megastep.agents.networks.kernels.library import aligned, check_shapes, is_plain
from megastep.agents.networks.lstm_cpu import CpuSequence, fits
from megastep.agents.networks.precision import cast, cast_joined, compute_dtype
from megastep.arrdict import arrdict

if TYPE_CHECKING:
    from types import ModuleType

_sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input  # (d, y): d y (1 - y)
_tanh_backward = torch.ops.aten.tanh_backward.grad_input  # (d, y): d (1 - y^2)


def _split(gates) -> tuple[torch.Tensor, ...]:
    return gates.view(len(gates), 4, -1).unbind(1)


def _start(reset, last_output, last_cell, hidden, cell) -> None:
    reset = reset[:, None]
    hidden.copy_(last_output).masked_fill_(reset, 0.0)
    cell.copy_(last_cell).masked_fill_(reset, 0.0)


def _forward(gates, cell, next_reset, output, next_hidden, next_cell) -> None:
    """Leaves the gates activated for `_backward`; the kernels recompute the activations instead."""
    i, f, g, o = _split(gates)
    gates[:, : 2 * i.shape[1]].sigmoid_()
    g.tanh_()
    o.sigmoid_()
    torch.mul(f, cell, out=next_cell).addcmul_(i, g)
    torch.tanh(next_cell, out=output).mul_(o)
    if next_reset is not None:
        reset = next_reset[:, None]
        next_hidden.copy_(output).masked_fill_(reset, 0.0)
        next_cell.masked_fill_(reset, 0.0)


def _backward(
    gates, cell, next_reset, d_output, d_next_hidden, d_next_cell, d_gates, d_cell
) -> None:
    i, f, g, o = _split(gates)
    d_i, d_f, d_g, d_o = _split(d_gates)
    squashed = (f * cell).addcmul_(i, g).tanh_()
    if next_reset is not None:
        reset = next_reset[:, None]
        d_output = d_output + d_next_hidden.masked_fill(reset, 0.0)
        d_next_cell = d_next_cell.masked_fill(reset, 0.0)
    d_after = _tanh_backward(d_output * o, squashed, grad_input=d_cell).add_(d_next_cell)
    _sigmoid_backward(d_after * g, i, grad_input=d_i)
    _sigmoid_backward(d_after * cell, f, grad_input=d_f)
    _tanh_backward(d_after * i, g, grad_input=d_g)
    _sigmoid_backward(squashed.mul_(d_output), o, grad_input=d_o)
    d_cell.mul_(f)


_CPU_STEPS = SimpleNamespace(start=_start, forward=_forward, backward=_backward)


def _steps(x) -> "ModuleType | SimpleNamespace":
    return kernels if x.is_cuda else _CPU_STEPS


def _unroll(
    x, input_weight, bias, weight, reset, output, cell, needs_backward, is_residual
) -> lstm_sequence.Unrolled:
    """Unrolls the recurrence step by step.

    Returns outputs (T, B, W), each step's recurrent input (T, B, W), the last output and cell
    (B, W), and what `_unroll_backward` needs.
    """
    steps = _steps(x)
    gates = F.linear(x, input_weight, bias)
    # hiddens[t] is the output of step t - 1 as step t sees it: 0 after a reset
    outputs, hiddens = torch.empty_like(x), torch.empty_like(x)
    cells = [torch.empty_like(cell)]
    steps.start(reset[0], output, cell, hiddens[0], cells[0])
    next_steps = [*zip(reset[1:], hiddens[1:], strict=True), (None, None)]
    for t, (next_reset, next_hidden) in enumerate(next_steps):
        gates[t].addmm_(hiddens[t], weight.T)
        cells.append(torch.empty_like(cells[t]))
        steps.forward(gates[t], cells[t], next_reset, outputs[t], next_hidden, cells[t + 1])
    last = outputs[-1].float()
    outputs = outputs + x if is_residual else outputs
    return outputs, hiddens, last, cells[-1], (gates, *cells[:-1])


def _unroll_backward(
    weight, reset, saved, d_outputs, d_cell, needs_state
) -> lstm_sequence.Gradients:
    """Returns the gradients of the gates (T, B, 4 W), of the bias and, if needed, of the output and
    the cell before the sequence. `d_cell` None: the last cell has no gradient.
    """
    gates, *cells = saved
    steps, d_gates = _steps(gates), torch.empty_like(gates)
    d_cell = torch.zeros_like(cells[0]) if d_cell is None else d_cell
    next_reset = d_hidden = None
    for t in reversed(range(len(reset))):
        d_next_cell, d_cell = d_cell, torch.empty_like(d_cell)
        steps.backward(
            *(gates[t], cells[t], next_reset),
            *(d_outputs[t], d_hidden, d_next_cell),
            *(d_gates[t], d_cell),
        )
        if t or needs_state:
            next_reset, d_hidden = reset[t], d_gates[t] @ weight
    d_bias = d_gates.flatten(0, 1).sum(0)
    if not needs_state:
        return d_gates, d_bias, None, None
    assert d_hidden is not None
    d_output = d_hidden.float().masked_fill_(reset[0, :, None], 0.0)
    return d_gates, d_bias, d_output, d_cell.masked_fill_(reset[0, :, None], 0.0)


def _unroll_on_chip(
    x, input_weight, bias, weight, reset, output, cell, needs_backward, is_residual
) -> lstm_sequence.Unrolled:
    """`_unroll` in one kernel after the inputs' product."""
    gates, residual = products.layer(x, input_weight, bias), x if is_residual else None
    return lstm_sequence.forward(gates, weight, reset, output, cell, needs_backward, residual)


def _unroll_on_chip_backward(
    weight, reset, saved, d_outputs, d_cell, needs_state
) -> lstm_sequence.Gradients:
    """`_unroll_backward` in one kernel."""
    gates, cells = saved
    return lstm_sequence.backward(weight, reset, gates, cells, d_outputs, d_cell)


class _Sequence(torch.autograd.Function):
    """The recurrence over time with an explicit gradient.

    Autograd would accumulate the weights' gradients step by step. Here each is one matrix product
    over all steps.
    """

    @staticmethod
    def forward(
        ctx, x, input_weight, bias, weight, reset, output, cell, is_residual=False, has_grad=True
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Unrolls the recurrence.

        Args:
            x: (T, B, W) in the compute dtype.
            input_weight: (4 W, W).
            bias: (4 W,).
            weight: (4 W, W), of the recurrent product.
            reset: (T, B) bool.
            output: (B, W) float32, last output before the sequence.
            cell: (B, W) float32, last cell before the sequence.
            is_residual: adds x to the outputs.
            has_grad: whether autograd is on; it never is in here.

        Returns:
            outputs (T, B, W) in the compute dtype, the last cell (B, W), and the last output (B, W)
            float32 without x.
        """
        ctx.set_materialize_grads(False)
        ctx.on_chip, ctx.is_residual = lstm_sequence.is_supported(x), is_residual
        unroll = _unroll_on_chip if ctx.on_chip else _unroll
        x, reset = aligned(x), reset.contiguous()
        input_weight, bias, weight = (cast(w, x.dtype) for w in (input_weight, bias, weight))
        outputs, hiddens, last_output, last_cell, saved = unroll(
            *(x, input_weight, bias, weight, reset, aligned(output), aligned(cell)),
            has_grad and any(ctx.needs_input_grad),
            is_residual,
        )
        ctx.save_for_backward(x, input_weight, weight, reset, hiddens, *saved)
        return outputs, last_cell, last_output

    @staticmethod
    @once_differentiable
    def backward(ctx, d_outputs, d_cell, d_last_output) -> tuple[torch.Tensor | None, ...]:
        x, input_weight, weight, reset, hiddens, *saved = ctx.saved_tensors
        d_sum = torch.zeros_like(x) if d_outputs is None else aligned(d_outputs)
        d_outputs = d_sum
        if d_last_output is not None:
            d_outputs = d_sum.clone()
            d_outputs[-1] += d_last_output
        d_cell = None if d_cell is None else aligned(d_cell)
        backward = _unroll_on_chip_backward if ctx.on_chip else _unroll_backward
        needs_state = any(ctx.needs_input_grad[5:7])
        d_gates, d_bias, d_output, d_cell = backward(
            weight, reset, saved, d_outputs, d_cell, needs_state
        )
        flat = d_gates.flatten(0, 1)
        return (
            products.of_inputs(d_gates, input_weight, d_sum if ctx.is_residual else None),
            products.of_weights(flat, x.flatten(0, 1)),
            d_bias.float(),
            products.of_weights(flat, hiddens.flatten(0, 1)),
            None,
            d_output,
            d_cell,
            None,
            None,
        )


class LSTM(nn.Module):
    """An LSTM of `width` units. Its hidden state is arrdict(output, cell), each (B, W) float32."""

    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.input = nn.Linear(width, 4 * width)
        self.recurrent = nn.Linear(width, 4 * width, bias=False)
        with torch.no_grad():
            for block in (*self.input.weight.split(width), *self.recurrent.weight.split(width)):
                nn.init.orthogonal_(block)
            # Forget gates start open, so that gradients reach far back from the beginning
            # (Jozefowicz et al. 2015)
            self.input.bias.zero_()[width : 2 * width] = 1.0

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the hidden state of B lanes at the start of an episode."""
        return arrdict(
            {key: torch.zeros(n_lanes, self.width, device=device) for key in ("output", "cell")}
        )

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict, is_residual: bool = False
    ) -> tuple[torch.Tensor, arrdict]:
        """Unrolls over a sequence, as the head of cores.py says. Outputs are in the
        compute dtype on a GPU and float32 on a CPU. ValueError if shapes or devices do not fit.
        """
        if is_plain():
            return self._plain(x, reset, state, is_residual)
        check_shapes(x, reset, state, ("output", "cell"))
        if len(x) == 1 and x.is_cuda and not torch.is_grad_enabled():
            return self._act(x, reset, state, is_residual)
        dtype = compute_dtype(self.recurrent.weight) if x.is_cuda else torch.float32
        x, states = x.to(dtype), (state["output"].float(), state["cell"].float())
        weights = self.input.weight, self.input.bias, self.recurrent.weight
        # autocast would choose its own dtypes inside
        with torch.autocast(x.device.type, enabled=False):
            if fits(x):
                outputs, cell = CpuSequence.apply(x, *weights, reset.bool(), *states)
                last_output, outputs = outputs[-1], outputs + x if is_residual else outputs
            else:
                sequence = x, *weights, reset.bool(), *states, is_residual, torch.is_grad_enabled()
                outputs, cell, last_output = _Sequence.apply(*sequence)
        return outputs, arrdict(output=last_output, cell=cell)

    def _plain(self, x, reset, state, is_residual) -> tuple[torch.Tensor, arrdict]:
        """Does the same as `forward` in float32, for exporters, which want nothing in place."""
        output, cell, outputs = state["output"], state["cell"], []
        for t in range(len(x)):
            output, cell = (leaf.masked_fill(reset[t, :, None], 0.0) for leaf in (output, cell))
            i, f, g, o = (self.input(x[t]) + self.recurrent(output)).chunk(4, -1)
            cell = f.sigmoid() * cell + i.sigmoid() * g.tanh()
            output = o.sigmoid() * cell.tanh()
            outputs.append(output + x[t] if is_residual else output)
        return torch.stack(outputs), arrdict(output=output, cell=cell)

    def _act(self, x, reset, state, is_residual) -> tuple[torch.Tensor, arrdict]:
        """Does the same as `forward` for one step on a GPU, without a gradient: with one product of
        inputs and last outputs.
        """
        dtype = compute_dtype(self.recurrent.weight)
        weight = cast_joined((self.input.weight, self.recurrent.weight), dtype)
        bias = cast(self.input.bias, dtype)
        x, reset = aligned(x[0].to(dtype)), reset[0].contiguous().bool()
        if self.width in few_rows.WIDTHS and few_rows.is_supported(x, weight):
            output, after = few_rows.lstm_step(x, weight, bias, reset, state, is_residual)
            return output[None], after
        last_output, last_cell = (aligned(state[key].float()) for key in ("output", "cell"))
        output, joined = torch.empty_like(x), x.new_empty(len(x), 2 * self.width)
        after = map(torch.empty_like, (last_output, last_cell))
        after = arrdict(zip(("output", "cell"), after))
        kernels.join(reset, x, last_output, joined)
        with torch.autocast(x.device.type, enabled=False):
            gates = F.linear(joined, weight, bias)
        residual = x if is_residual else None
        kernels.act(gates, reset, last_cell, residual, output, after.output, after.cell)
        return output[None], after
