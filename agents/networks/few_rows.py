"""Matrix products of few rows on a GPU, in blocks that leave a multiprocessor to several others.
The libraries' products of a few hundred rows take most of the GPU for themselves, and those of many
streams wait for each other.

N rows, K inputs, M outputs. Matrices are bfloat16 and on one GPU. Their rows are contiguous and
start at multiples of 16 bytes, which K and M fill.
"""

from pathlib import Path

import torch

from megastep.agents.networks.fused import fused
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels" / "few_rows", FAST_CUDA_FLAGS)
MAX_ROWS, _TILE, _TILE_THREADS, _TILE_BYTES = (
    LIBRARY.constants[name] for name in ("MAX_ROWS", "TILE", "TILE_THREADS", "TILE_BYTES")
)


@fused(lambda *matrices: True, lambda *matrices: _fit(matrices))
def fits(*matrices: torch.Tensor) -> bool:
    """Returns whether the kernels take rows (N, K) and other matrices on their device."""
    return False


def _fit(matrices) -> bool:
    rows = matrices[0]
    if not rows.is_cuda or not 0 < len(rows) <= MAX_ROWS:
        return False
    return torch.cuda.get_device_capability(rows.device) >= (8, 0) and all(
        matrix.dtype == torch.bfloat16
        and not (matrix.shape[1] % 8 or matrix.stride(0) % 8 or matrix.data_ptr() % 16)
        and matrix.stride(1) == 1
        and matrix.stride(0) >= matrix.shape[1]
        for matrix in matrices
    )


def multiply(
    x: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor | None = None,
    addend: torch.Tensor | None = None,
    out: torch.Tensor | None = None,
    has_relu: bool = False,
    of_inputs: bool = False,
) -> torch.Tensor:
    """Returns the product of rows (N, K) and a weight (M, K), or (K, M) if `of_inputs`, plus a bias
    (M,) and an addend (N, M), with a ReLU if `has_relu`; in `out` (N, M), if given.
    """
    n_columns = weight.shape[1] if of_inputs else len(weight)
    out = x.new_empty(len(x), n_columns) if out is None else out
    n_tiles = -(-n_columns // _TILE), -(-len(x) // _TILE)
    launch(
        *(LIBRARY, "product_of_inputs" if of_inputs else "product_of_layer", x.device),
        Blocks(*n_tiles, _TILE_THREADS, _TILE_BYTES),
        **dict(left=x, right=weight, bias=bias, addend=addend, result=out),
        **dict(n_rows=len(x), n_columns=n_columns, n_inner=x.shape[1], has_relu=int(has_relu)),
        **dict(left_stride=x.stride(0), right_stride=weight.stride(0), result_stride=out.stride(0)),
    )
    return out
