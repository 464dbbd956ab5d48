"""The minGRU on a GPU after its matrix product: a kernel for all steps, and one for all steps back.

Axes: T time, B lanes, W units. All tensors are contiguous, and where W is a multiple of 4 they
begin at a multiple of four elements. Gates (T, B, 2 W), outputs (T, B, W) and their gradients are
in the compute dtype, states (B, W) in float32, resets (T, B) bool. Each function writes to the
tensors given last.
"""

from megastep.agents.networks.kernels.program import run


def forward(gates, reset, start, outputs, last):
    """From the gates before their activation and the state before the first step to the outputs and
    the state after the last.
    """
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
    """The gradients of `forward` in its gates and its first state, from those in what it gave."""
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
