"""The LSTM on a GPU between its matrix products: a kernel before the first step, one per step, and
one per step back.

Axes: B lanes, W units. All tensors are contiguous, and where W is a multiple of 4 they begin at a
multiple of four elements. Gates, outputs, memories and their gradients are in the compute dtype,
cells in float32, resets bool. Each function writes to the tensors given last.
"""

from megastep.agents.networks.kernels.program import run


def start(reset, last_output, last_cell, memory, cell):
    """What the first step remembers, (B, W): the last output and cell, or zero where `reset` (B).
    `last_output` is float32.
    """
    run(
        "lstm_start",
        memory.dtype,
        cell,
        reset=reset,
        last_output=last_output,
        last_cell=last_cell,
        memory=memory,
        cell=cell,
    )


def forward(gates, cell, next_reset, output, next_memory, next_cell):
    """From the gates before their activation (B, 4 W) and the cell (B, W) to the output, and to the
    output and the cell as the next step remembers them: zero where `next_reset` (B). If there is no
    next step, `next_reset` and `next_memory` are None.
    """
    run(
        "lstm_forward",
        gates.dtype,
        cell,
        gates=gates,
        cell=cell,
        next_reset=next_reset,
        output=output,
        next_memory=next_memory,
        next_cell=next_cell,
    )


def backward(gates, cell, next_reset, d_output, d_next_memory, d_next_cell, d_gates, d_cell):
    """The gradients of `forward` in its gates and its cell, from those in what it gave."""
    run(
        "lstm_backward",
        gates.dtype,
        cell,
        gates=gates,
        cell=cell,
        next_reset=next_reset,
        d_output=d_output,
        d_next_memory=d_next_memory,
        d_next_cell=d_next_cell,
        d_gates=d_gates,
        d_cell=d_cell,
    )
