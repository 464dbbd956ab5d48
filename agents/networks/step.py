"""One step of a recurrent core when acting, in one kernel on a GPU: the product of its gates and
the recurrence. B lanes, W units.
"""

from pathlib import Path

import torch

from megastep.agents.networks.fused import aligned, fused, has_hopper
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels" / "acting", FAST_CUDA_FLAGS)
_LANES, _ROWS, _INNER, _STAGES, _THREADS = (
    LIBRARY.constants[name] for name in "LANES ROWS INNER STAGES THREADS".split()
)
MINGRU, LSTM = 2, 4  # the gates G of the cores that have a kernel
OPERATIONS = {MINGRU: "mingru_step", LSTM: "lstm_step"}


def blocks(n_gates: int, n_lanes: int, width: int) -> Blocks:
    """Returns the blocks that step all lanes."""
    n_blocks = -(-n_lanes // _LANES) * width * n_gates // _ROWS
    return Blocks(n_blocks, 1, _THREADS, _STAGES * (_LANES + _ROWS) * 2 * _INNER)


@fused(lambda *_: True, lambda *args: _fits(*args))
def fits(n_gates: int, x: torch.Tensor, dtype: torch.dtype) -> bool:
    """Returns whether `step` takes inputs x (T, B, W) on their device, to compute in `dtype`."""
    return False


def _fits(n_gates, x, dtype) -> bool:
    is_step = x.is_cuda and dtype == torch.bfloat16 and len(x) == 1 and not x.shape[-1] % _INNER
    return is_step and has_hopper(x.device, blocks(n_gates, 0, x.shape[-1]).shared)


def step(
    n_gates: int,
    x: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    reset: torch.Tensor,
    state: torch.Tensor,
    is_residual: bool,
    last_output: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """Returns outputs (1, B, W) bfloat16, the state (B, W) float32 and, of an LSTM, the output (B,
    W) bfloat16 without the residual, after a step, without what its gradient needs.

    Args:
        x: (1, B, W) bfloat16; added to the outputs if `is_residual`.
        weight: (G W, K) bfloat16: of x and, of an LSTM, then of the last output.
        bias: (G W,) bfloat16.
        reset: (1, B) bool; clears a lane's state before the step.
        state: (B, W) float32, the minGRU's, or the LSTM's cell.
        last_output: (B, W), the LSTM's.
    """
    x, state, (n_lanes, width) = aligned(x), aligned(state), state.shape
    outputs, next_state, next_output = torch.empty_like(x), torch.empty_like(state), None
    if last_output is not None:
        last_output = aligned(last_output.to(x.dtype))
        next_output = torch.empty_like(last_output)
    launch(
        *(LIBRARY, OPERATIONS[n_gates], x.device, blocks(n_gates, n_lanes, width)),
        **dict(x=x, weight=aligned(weight), bias=aligned(bias), reset=reset.contiguous()),
        **dict(last_output=last_output, last_state=state),
        **dict(outputs=outputs, next_output=next_output, next_state=next_state),
        **dict(n_lanes=n_lanes, width=width, is_residual=int(is_residual)),
    )
    return outputs, next_state, next_output
