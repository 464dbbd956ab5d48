"""The minGRU on a GPU after its matrix product: one kernel for all steps, one for all steps back.

T steps, B lanes, W units. All tensors are contiguous; if W is a multiple of 4, they start at a
multiple of four elements. Gates (T, B, 2 W), before activation, states and outputs (T, B, W) and
their gradients are in the compute dtype, `start` and `last` (B, W) are float32, resets (T, B) are
bool.
"""

from typing import TYPE_CHECKING

from megastep.agents.networks.kernels.layers import sum_rows
from megastep.agents.networks.kernels.library import (
    LIBRARY,
    kernel,
    n_threads,
    sizes,
    units_per_thread,
)
from megastep.kernels.build.launch import BLOCK, Blocks, launch

if TYPE_CHECKING:
    import torch

_LARGEST_BLOCK = 256  # threads, of `backward`
_MANY_BLOCKS = 128  # about one per multiprocessor


def forward(gates, reset, start, residual, states, outputs, last) -> None:
    """Computes the last three from the gates and the first state.

    Args:
        residual: (T, B, W), added to the outputs. None: nothing is.
        states: the outputs without the residual. None: not wanted.
    """
    operation = "mingru_step" if len(gates) == 1 else "mingru_forward"
    launch(
        *(LIBRARY, kernel(operation, gates.dtype), start.device, n_threads(start)),
        **sizes(start),
        gates=gates,
        reset=reset,
        start=start,
        residual=residual,
        states=states,
        outputs=outputs,
        last=last,
        n_steps=len(gates),
    )


def backward(
    gates, reset, start, states, d_outputs, d_last, d_gates, d_start, d_residual
) -> "torch.Tensor":
    """Computes the gradients of `forward`'s gates and first state from those of its outputs.

    Args:
        d_last: None: zeros.
        d_start: None: not wanted.
        d_residual: (T, B, W), a copy of `d_outputs`. None: not wanted.

    Returns:
        the gates' gradient summed over steps and lanes, (2 W,) float32.
    """
    n_lanes, width = start.shape
    n_units = units_per_thread(width)
    per_lane = width // n_units  # threads
    per_block = max(1, min(_LARGEST_BLOCK // per_lane, n_lanes // _MANY_BLOCKS))  # lanes
    adds_lanes = per_lane <= _LARGEST_BLOCK
    block = per_block * per_lane if adds_lanes else BLOCK
    d_biases = start.new_empty(-(-n_lanes // per_block), gates.shape[-1])
    blocks = Blocks(-(-n_threads(start) // block), threads=block, shared=4 * n_units * block)
    launch(
        *(LIBRARY, kernel("mingru_backward", gates.dtype), start.device, blocks),
        **sizes(start),
        gates=gates,
        reset=reset,
        start=start,
        states=states,
        d_outputs=d_outputs,
        d_last=d_last,
        d_gates=d_gates,
        d_start=d_start,
        d_residual=d_residual,
        d_biases=d_biases,
        n_steps=len(gates),
        adds_lanes=int(adds_lanes),
    )
    return sum_rows(d_biases)
