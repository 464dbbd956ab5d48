"""The LSTM's recurrence on a CPU: one kernel for a whole sequence, and one for its gradient.

T time, B lanes, W width. `megastep.agents.networks.lstm` has the same as PyTorch operations.
"""

import torch
from torch.autograd.function import once_differentiable

from megastep.agents.networks.kernels.library import LIBRARY, is_built_for_cpu
from megastep.agents.networks.linear_cpu import matmul
from megastep.engine.devices import threads
from megastep.kernels.build.launch import launch

MULTIPLE = 16  # of which the width must be one


def fits(x: torch.Tensor) -> bool:
    """Returns whether the kernels can take inputs (T, B, W), which needs a C++ compiler."""
    return x.device.type == "cpu" and x.shape[-1] % MULTIPLE == 0 and is_built_for_cpu()


class CpuSequence(torch.autograd.Function):
    """`lstm._Sequence` in float32: the same arguments, results and gradients."""

    @staticmethod
    def forward(
        ctx, x, input_weight, bias, weight, reset, output, cell
    ) -> tuple[torch.Tensor, torch.Tensor]:
        inputs = x, input_weight, bias, weight, reset, output, cell
        x, input_weight, bias, weight, reset, output, cell = (one.contiguous() for one in inputs)
        gates = x.new_empty((*x.shape[:2], 4 * x.shape[2]))
        hiddens, cells, outputs = (torch.empty_like(x) for _ in range(3))
        last_cell = torch.empty_like(cell)
        n_steps, n_lanes, width = x.shape
        launch(
            *(LIBRARY, "lstm_sequence_forward", x.device, 0),
            x=x,
            input_weight=input_weight,
            bias=bias,
            weight=weight,
            reset=reset,
            first_output=output,
            first_cell=cell,
            gates=gates,
            hiddens=hiddens,
            cells=cells,
            outputs=outputs,
            last_cell=last_cell,
            n_steps=n_steps,
            n_lanes=n_lanes,
            width=width,
            n_threads=threads(),
        )
        ctx.save_for_backward(x, input_weight, weight, reset, gates, hiddens, cells)
        return outputs, last_cell

    @staticmethod
    @once_differentiable
    def backward(
        ctx, d_outputs, d_last_cell
    ) -> tuple[
        torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, None, torch.Tensor, torch.Tensor
    ]:
        x, input_weight, weight, reset, gates, hiddens, cells = ctx.saved_tensors
        d_gates, d_x = torch.empty_like(gates), torch.empty_like(x)
        d_output, d_cell = torch.empty_like(d_last_cell), torch.empty_like(d_last_cell)
        n_steps, n_lanes, width = x.shape
        launch(
            *(LIBRARY, "lstm_sequence_backward", x.device, 0),
            input_weight=input_weight,
            weight=weight,
            reset=reset,
            gates=gates,
            cells=cells,
            d_outputs=d_outputs.contiguous(),
            d_last_cell=d_last_cell.contiguous(),
            d_gates=d_gates,
            d_x=d_x,
            d_output=d_output,
            d_cell=d_cell,
            n_steps=n_steps,
            n_lanes=n_lanes,
            width=width,
            n_threads=threads(),
        )
        flat = d_gates.flatten(0, 1)
        d_input_weight, d_weight = (matmul(flat.T, rows.flatten(0, 1)) for rows in (x, hiddens))
        return d_x, d_input_weight, flat.sum(0), d_weight, None, d_output, d_cell
