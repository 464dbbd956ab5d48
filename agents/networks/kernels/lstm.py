"""The LSTM on a GPU between its matrix products: one kernel before the first step, one per step,
and one per backward step; two others per step when acting.

B lanes, W units. All tensors are contiguous; if W is a multiple of 4, they start at a multiple of
four elements. Gates are before activation. Gates, outputs, hidden states and their gradients are in
the compute dtype, cells are float32, resets are bool. Each function writes to its last arguments.
"""

from megastep.agents.networks.kernels.library import LIBRARY, kernel, n_threads, sizes
from megastep.kernels.build.launch import launch


def start(reset, last_output, last_cell, hidden, cell) -> None:
    """Computes the first step's input state: the last output and cell, zeroed where `reset`.

    Args:
        reset: (B,) bool, of the first step.
        last_output: (B, W) float32.
        last_cell: (B, W) float32.
        hidden: (B, W), written.
        cell: (B, W), written.
    """
    launch(
        *(LIBRARY, kernel("lstm_start", hidden.dtype), hidden.device, n_threads(hidden)),
        **sizes(hidden),
        reset=reset,
        last_output=last_output,
        last_cell=last_cell,
        hidden=hidden,
        cell=cell,
    )


def join(reset, x, last_output, joined) -> None:
    """Joins what the gates are computed from: x and the last output, zeroed where `reset`.

    Args:
        reset: (B,) bool.
        x: (B, W).
        last_output: (B, W) float32.
        joined: (B, 2 W), written.
    """
    launch(
        *(LIBRARY, kernel("lstm_join", x.dtype), last_output.device, n_threads(last_output)),
        **sizes(last_output),
        reset=reset,
        x=x,
        last_output=last_output,
        joined=joined,
    )


def act(gates, reset, last_cell, residual, output, next_output, next_cell) -> None:
    """Computes one step without a gradient, from gates of what `join` joined.

    Args:
        gates: (B, 4 W).
        reset: (B,) bool.
        last_cell: (B, W) float32, before the reset.
        residual: (B, W), added to `output`, or None.
        output: (B, W), written.
        next_output: (B, W) float32, written: the same numbers without the residual.
        next_cell: (B, W), written.
    """
    launch(
        *(LIBRARY, kernel("lstm_act", gates.dtype), last_cell.device, n_threads(last_cell)),
        **sizes(last_cell),
        gates=gates,
        reset=reset,
        last_cell=last_cell,
        residual=residual,
        output=output,
        next_output=next_output,
        next_cell=next_cell,
    )


def forward(gates, cell, next_reset, output, next_hidden, next_cell) -> None:
    """Computes a step's output, and the input state of the next step.

    Args:
        gates: (B, 4 W).
        cell: (B, W).
        next_reset: (B,) bool, where the next step's input state is zeroed; None without a next
            step.
        output: (B, W), written.
        next_hidden: (B, W), written; None without a next step.
        next_cell: (B, W), written.
    """
    launch(
        *(LIBRARY, kernel("lstm_forward", gates.dtype), cell.device, n_threads(cell)),
        **sizes(cell),
        gates=gates,
        cell=cell,
        next_reset=next_reset,
        output=output,
        next_hidden=next_hidden,
        next_cell=next_cell,
    )


def backward(
    gates, cell, next_reset, d_output, d_next_hidden, d_next_cell, d_gates, d_cell
) -> None:
    """Computes the gradients of `forward`'s gates and cell from those of its outputs."""
    launch(
        *(LIBRARY, kernel("lstm_backward", gates.dtype), cell.device, n_threads(cell)),
        **sizes(cell),
        gates=gates,
        cell=cell,
        next_reset=next_reset,
        d_output=d_output,
        d_next_hidden=d_next_hidden,
        d_next_cell=d_next_cell,
        d_gates=d_gates,
        d_cell=d_cell,
    )
