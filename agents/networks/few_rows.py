"""Matrix products of few rows on a GPU, and a step of the LSTM, in blocks that leave a
multiprocessor to several others. The libraries' products of a few hundred rows take most of the GPU
for themselves, and those of many streams wait for each other.

N rows, K inputs, M outputs; B lanes, W units. Matrices are bfloat16 and on one GPU. Their rows are
contiguous and start at multiples of 16 bytes, which K and M fill.
"""

from pathlib import Path

import torch

from megastep.agents.networks.fused import aligned, fused
from megastep.arrdict import arrdict
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels" / "few_rows", FAST_CUDA_FLAGS)
_SIZES = LIBRARY.constants
_TILE = _SIZES["TILE"]
WIDTHS = 128, 256
MAX_ROWS = _SIZES["MAX_ROWS"]


@fused(lambda *matrices: True, lambda *matrices: _fit(matrices))
def fits(*matrices: torch.Tensor) -> bool:
    """Returns whether the kernels take rows (N, K) and other matrices on their device."""
    return False


def fits_step(x: torch.Tensor, weight: torch.Tensor) -> bool:
    """Returns whether `lstm_step` takes inputs (B, W) and their weight."""
    return x.shape[1] in WIDTHS and fits(x, weight)


def _fit(matrices) -> bool:
    rows = matrices[0]
    if not rows.is_cuda or not 0 < len(rows) <= MAX_ROWS:
        return False
    has_bf16 = torch.cuda.get_device_capability(rows.device) >= (8, 0)
    return has_bf16 and all(map(_has_words, matrices))


def _has_words(matrix) -> bool:
    """Returns whether a matrix is as the head of this file says."""
    n_columns, is_bf16 = matrix.shape[1], matrix.dtype == torch.bfloat16
    has_words = not (n_columns % 8 or matrix.stride(0) % 8 or matrix.data_ptr() % 16)
    return is_bf16 and has_words and matrix.stride(1) == 1 and matrix.stride(0) >= n_columns


def layer(
    x: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor | None = None,
    has_relu: bool = False,
    onto: torch.Tensor | None = None,
) -> torch.Tensor:
    """Does what `linear.product` does."""
    result = x.new_empty(len(x), len(weight)) if onto is None else onto
    return _multiply("product_of_layer", x, weight, result, bias, onto, has_relu)


def of_inputs(
    d: torch.Tensor, weight: torch.Tensor, addend: torch.Tensor | None = None
) -> torch.Tensor:
    """Does what `linear.gradient_of_inputs` does."""
    result = d.new_empty(len(d), weight.shape[1])
    return _multiply("product_of_inputs", d, weight, result, None, addend)


def _multiply(operation, left, right, result, bias, addend, has_relu=False) -> torch.Tensor:
    (n_rows, n_columns), n_inner = result.shape, left.shape[1]
    n_tiles = -(-n_columns // _TILE), -(-n_rows // _TILE)
    launch(
        *(LIBRARY, operation, left.device),
        Blocks(*n_tiles, _SIZES["TILE_THREADS"], _SIZES["TILE_BYTES"]),
        **dict(left=left, right=right, bias=bias, addend=addend, result=result),
        **dict(n_rows=n_rows, n_columns=n_columns, n_inner=n_inner, has_relu=int(has_relu)),
        **dict(left_stride=left.stride(0), right_stride=right.stride(0)),
        result_stride=result.stride(0),
    )
    return result


def lstm_step(
    x: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    reset: torch.Tensor,
    state: arrdict,
    is_residual: bool,
) -> tuple[torch.Tensor, arrdict]:
    """Returns output (B, W) and state after a step, without what its gradient needs. Gates are
    float32.

    Args:
        x: (B, W), W in `WIDTHS`; added to the output if `is_residual`.
        weight: (4 W, 2 W): of x, then of the last output.
        bias: (4 W,).
        reset: (B,) bool; clears a lane's state before the step.
        state: arrdict(output, cell), (B, W) float32 each, before the step.
    """
    x, output, width = aligned(x), torch.empty_like(x), x.shape[1]
    after = state.map(torch.empty_like)
    n_blocks = -(-len(x) // _SIZES["STEP_LANES"]) * width // _SIZES["STEP_UNITS"]
    launch(
        *(LIBRARY, f"lstm_step_{width}", x.device, Blocks(n_blocks, 1, _SIZES["STEP_THREADS"])),
        **dict(x=x, weight=weight, bias=bias, reset=reset, output=output),
        **dict(last_output=state["output"], last_cell=state["cell"]),
        **dict(next_output=after["output"], next_cell=after["cell"]),
        **dict(n_lanes=len(x), is_residual=int(is_residual)),
    )
    return output, after
