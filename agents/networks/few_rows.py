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
    """Returns the outputs (N, M) of a linear layer.

    Args:
        x: (N, K).
        weight: (M, K).
        bias: (M,), contiguous.
        has_relu: applies a ReLU.
        onto: (N, M), to which the product is added, in place; None: to nothing.
    """
    result = x.new_empty(len(x), len(weight)) if onto is None else onto
    _multiply("product_of_layer", x, weight, result, x.shape[1], bias, onto, has_relu)
    return result


def of_inputs(
    d: torch.Tensor, weight: torch.Tensor, addend: torch.Tensor | None = None
) -> torch.Tensor:
    """Returns the gradient (N, K) of a layer's inputs.

    Args:
        d: (N, M), that of its outputs.
        weight: (M, K).
        addend: (N, K), contiguous, is added.
    """
    result = d.new_empty(len(d), weight.shape[1])
    _multiply("product_of_inputs", d, weight, result, d.shape[1], addend=addend)
    return result


def _multiply(
    operation, left, right, result, n_inner, bias=None, addend=None, has_relu=False
) -> None:
    n_rows, n_columns = result.shape
    n_tiles = -(-n_columns // _TILE), -(-n_rows // _TILE)
    blocks = Blocks(*n_tiles, _SIZES["TILE_THREADS"], _SIZES["TILE_BYTES"])
    launch(
        *(LIBRARY, operation, left.device, blocks),
        left=left,
        right=right,
        bias=bias,
        addend=addend,
        result=result,
        n_rows=n_rows,
        n_columns=n_columns,
        n_inner=n_inner,
        left_stride=left.stride(0),
        right_stride=right.stride(0),
        result_stride=result.stride(0),
        has_relu=int(has_relu),
    )


def lstm_step(
    x: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    reset: torch.Tensor,
    state: arrdict,
    is_residual: bool,
) -> tuple[torch.Tensor, arrdict]:
    """Computes a step without what its gradient needs. Gates are float32.

    Args:
        x: (B, W), W in `WIDTHS`.
        weight: (4 W, 2 W): of x, then of the last output.
        bias: (4 W,).
        reset: (B,) bool; clears a lane's state before the step.
        state: arrdict(output, cell), (B, W) each, before the step.
        is_residual: adds x to the output.

    Returns:
        output (B, W) bfloat16, and the state after the step.
    """
    last_output, last_cell = (aligned(state[key].float()) for key in ("output", "cell"))
    x, output, width = aligned(x), torch.empty_like(x), x.shape[1]
    after = arrdict(output=torch.empty_like(last_output), cell=torch.empty_like(last_cell))
    n_blocks = -(-len(x) // _SIZES["STEP_LANES"]) * width // _SIZES["STEP_UNITS"]
    launch(
        *(LIBRARY, f"lstm_step_{width}", x.device, Blocks(n_blocks, 1, _SIZES["STEP_THREADS"])),
        x=x,
        weight=weight,
        bias=bias,
        reset=reset,
        last_output=last_output,
        last_cell=last_cell,
        output=output,
        next_output=after.output,
        next_cell=after.cell,
        n_lanes=len(x),
        is_residual=int(is_residual),
    )
    return output, after
