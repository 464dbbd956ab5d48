"""One step of the minGRU on a GPU with tensor cores for bfloat16 and much shared memory (Hopper and
later): the product of its gates and the recurrence in one kernel.

B lanes, W units. All tensors are on one GPU.
"""

from pathlib import Path

import torch

from megastep.agents.networks.fused import aligned, fused
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels" / "acting", FAST_CUDA_FLAGS)
_LANES, _UNITS, _PARTS, _THREADS = (
    LIBRARY.constants[f"STEP_{name}"] for name in "LANES UNITS PARTS THREADS".split()
)
WIDTHS = tuple(range(_UNITS, (_PARTS + 1) * _UNITS, _UNITS))


@fused(lambda x: True, lambda x: _fit(x))
def fits(x: torch.Tensor) -> bool:
    """Returns whether the kernel takes inputs x (T, B, W) of this dtype on their device."""
    return False


def _fit(x) -> bool:
    n_steps, _, width = x.shape
    if not x.is_cuda or x.dtype != torch.bfloat16 or n_steps != 1 or width not in WIDTHS:
        return False
    gpu = torch.cuda.get_device_properties(x.device)
    return gpu.major >= 9 and gpu.shared_memory_per_block_optin >= _shared(width)


def forward(
    x: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    reset: torch.Tensor,
    start: torch.Tensor,
    is_residual: bool,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Computes a step without what its gradient needs.

    Gates are float32 sums, rounded to bfloat16 after the bias.

    Args:
        x: (1, B, W) bfloat16.
        weight: (2 W, W) bfloat16.
        bias: (2 W,) bfloat16.
        reset: (1, B) bool; clears a lane's state before the step.
        start: (B, W) float32, state before the step.
        is_residual: adds x to the outputs.

    Returns:
        outputs (1, B, W) bfloat16, and the state after the step (B, W) float32.
    """
    x, start = aligned(x), aligned(start)
    outputs, last = torch.empty_like(x), torch.empty_like(start)
    width = x.shape[-1]
    launch(
        *(LIBRARY, f"mingru_step_{width}", x.device, blocks(len(start), width)),
        x=x,
        weight=aligned(weight),
        bias=aligned(bias),
        reset=reset.contiguous(),
        start=start,
        outputs=outputs,
        last=last,
        n_lanes=len(start),
        is_residual=int(is_residual),
    )
    return outputs, last


def blocks(n_lanes: int, width: int) -> Blocks:
    """Returns the blocks that step all lanes."""
    n_blocks = -(-n_lanes // _LANES) * width // _UNITS
    return Blocks(n_blocks, 1, _THREADS, _shared(width))


def _shared(width) -> int:
    """Returns the bytes of shared memory of a block."""
    n_bytes = LIBRARY.constants
    of_parts = width // _UNITS * n_bytes["PART_BYTES"]
    return of_parts + _LANES * n_bytes["STATE_BYTES"] + n_bytes["BIAS_BYTES"]
