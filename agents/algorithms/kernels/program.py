"""The algorithms' kernels for the GPU."""

from pathlib import Path

import torch

from megastep.agents.networks.kernels.program import CUDA_FLAGS
from megastep.kernels.build.launch import BLOCK, addresses, launch_blocks
from megastep.kernels.build.program import Program

PROGRAM = Program(Path(__file__).parent, CUDA_FLAGS)


def run(
    operation: str,
    device: torch.device,
    n_threads: int,
    n_blocks_y: int = 1,
    block: int = BLOCK,
    **fields,
) -> None:
    """Launches an operation.

    Args:
        operation: its name.
        device: where the tensors are.
        n_threads: along x, rounded up to whole blocks.
        n_blocks_y: blocks along y.
        block: threads of a block.
        fields: the fields of its struct. A tensor stands for its address, None for null.
    """
    values = addresses(fields)
    pack = getattr(PROGRAM.params, PROGRAM.cuda_operations[operation])
    shape = (-(-n_threads // block), n_blocks_y), block
    launch_blocks(PROGRAM, operation, pack(**values), device, *shape)


def n_blocks(n_threads: int) -> int:
    """Returns the number of blocks of a launch."""
    return -(-n_threads // BLOCK)
