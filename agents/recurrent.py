"""A long short-term memory (Hochreiter and Schmidhuber 1997) whose state is cleared inside a
sequence where an episode starts.

Axes: T time, B lanes, W width. Gates are laid out (..., 4 W): input, forget, candidate, output, as
PyTorch's own are. Matrix products run in the compute dtype (autocast's), the cell and its gates in
float32: over hundreds of steps a bfloat16 cell would round small additions away.
"""

import torch
from torch import nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from agents.heads import compute_dtype
from megastep.arrdict import arrdict


def _cell(from_input, from_memory, before):
    """One step of all lanes: the two halves of the gates (B, 4 W) and the cell before it (B, W),
    float32.

    Returns the output and the cell after it (B, W), and the activated gates (B, 4 W) for
    `_cell_backward`.
    """
    if before.is_cuda:
        return torch.ops.aten._thnn_fused_lstm_cell(from_input, from_memory, before)
    gates = from_input + from_memory
    i, f, g, o = gates.chunk(4, -1)
    gates[:, : 2 * f.shape[-1]].sigmoid_()
    g.tanh_()
    o.sigmoid_()
    after = (f * before).addcmul_(i, g)
    return after.tanh().mul_(o), after, gates


def _cell_backward(d_output, d_after, before, after, gates):
    """Gradients of `_cell` in the gates before their activation (B, 4 W) and in the cell before the
    step (B, W).
    """
    if before.is_cuda:
        return torch.ops.aten._thnn_fused_lstm_cell_backward_impl(
            d_output, d_after, before, after, gates, False
        )[:2]
    i, f, g, o = gates.chunk(4, -1)
    squashed = after.tanh()
    d_cell = torch.addcmul(d_after, d_output * o, 1 - squashed * squashed)
    d_gates = torch.cat(
        [
            d_cell * g * i * (1 - i),
            d_cell * before * f * (1 - f),
            d_cell * i * (1 - g * g),
            d_output * squashed * o * (1 - o),
        ],
        -1,
    )
    return d_gates, d_cell * f


class _Sequence(torch.autograd.Function):
    """The recurrence over time, with its gradient written out.

    Autograd would add up the weight's gradient step by step; here it is one matrix product for all
    of time.
    """

    @staticmethod
    def forward(ctx, from_input, weight, reset, output, cell):
        """from_input (T, B, 4 W) and weight (4 W, W) in the compute dtype, reset (T, B, 1), output
        and cell (B, W) float32. Returns outputs (T, B, W) in the compute dtype and the last cell.
        """
        outputs = from_input.new_empty(*reset.shape[:2], weight.shape[1])
        memories = torch.empty_like(outputs)
        ctx.steps = []
        for t in range(len(reset)):
            memories[t] = output.masked_fill(reset[t], 0.0)
            before = cell.masked_fill(reset[t], 0.0)
            output, cell, gates = _cell(
                from_input[t].float(), (memories[t] @ weight.T).float(), before
            )
            outputs[t] = output
            ctx.steps.append((before, cell, gates))
        ctx.save_for_backward(weight, reset, memories)
        return outputs, cell

    @staticmethod
    @once_differentiable
    def backward(ctx, d_outputs, d_cell):
        weight, reset, memories = ctx.saved_tensors
        d_gates = weight.new_empty(*reset.shape[:2], weight.shape[0])
        d_output = torch.zeros_like(d_cell)
        for t in reversed(range(len(reset))):
            d_step, d_cell = _cell_backward(d_output + d_outputs[t], d_cell, *ctx.steps[t])
            d_gates[t] = d_step
            d_output = (d_gates[t] @ weight).float().masked_fill_(reset[t], 0.0)
            d_cell = d_cell.masked_fill(reset[t], 0.0)
        d_weight = d_gates.flatten(0, 1).T @ memories.flatten(0, 1)
        return d_gates, d_weight, None, d_output, d_cell


class LSTM(nn.Module):
    """An LSTM of `width` units. Between calls its state is arrdict(output, cell), each (B, W)
    float32.
    """

    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.input = nn.Linear(width, 4 * width)
        self.memory = nn.Linear(width, 4 * width, bias=False)
        with torch.no_grad():
            for block in (*self.input.weight.split(width), *self.memory.weight.split(width)):
                nn.init.orthogonal_(block)
            # A forget gate that starts open, so that gradients reach back from the start
            # (Jozefowicz et al. 2015)
            self.input.bias.zero_()[width : 2 * width] = 1.0

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """The state of lanes at the start of an episode."""
        return arrdict(
            {key: torch.zeros(n_lanes, self.width, device=device) for key in ("output", "cell")}
        )

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict
    ) -> tuple[torch.Tensor, arrdict]:
        """Runs over x (T, B, W) from a state; a lane's state is cleared before each step where
        reset (T, B).

        Returns the outputs (T, B, W) and the state after the last step.
        """
        dtype = compute_dtype(self.memory.weight)
        from_input = F.linear(x.to(dtype), self.input.weight.to(dtype), self.input.bias.to(dtype))
        weight = self.memory.weight.to(dtype)
        # autocast would take the fused cell to low precision
        with torch.autocast(x.device.type, enabled=False):
            outputs, cell = _Sequence.apply(
                from_input, weight, reset[..., None], state["output"], state["cell"]
            )
        return outputs, arrdict(output=outputs[-1].float(), cell=cell)

    def step(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict
    ) -> tuple[torch.Tensor, arrdict]:
        """One step, x (B, W) and reset (B,): the outputs (B, W) and the state after it."""
        outputs, state = self(x[None], reset[None], state)
        return outputs[0], state
