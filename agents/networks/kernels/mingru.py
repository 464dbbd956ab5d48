"""The minGRU on a GPU after its matrix product: one kernel for all steps, one for all steps back.

T steps, B lanes, W units. All tensors are contiguous; if W is a multiple of 4, they start at a
multiple of four elements. Gates (T, B, 2 W), before activation, outputs (T, B, W) and their
gradients are in the compute dtype, states (B, W) are float32, resets (T, B) are bool. Each function
writes to its last arguments.
"""

from megastep.agents.networks.kernels.program import run


def forward(gates, reset, start, outputs, last):
    """Computes the outputs and the last state from the gates and the first state."""
    run(
        "mingru_forward",
        gates.dtype,
        start,
        gates=gates,
        reset=reset,
        start=start,
        outputs=outputs,
        last=last,
        n_steps=len(gates),
    )


def backward(gates, reset, start, outputs, d_outputs, d_last, d_gates, d_start):
    """Computes the gradients of `forward`'s gates and first state from those of its outputs."""
    run(
        "mingru_backward",
        gates.dtype,
        start,
        gates=gates,
        reset=reset,
        start=start,
        outputs=outputs,
        d_outputs=d_outputs,
        d_last=d_last,
        d_gates=d_gates,
        d_start=d_start,
        n_steps=len(gates),
    )
