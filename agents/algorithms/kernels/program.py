"""The algorithms' kernels for the GPU."""

from pathlib import Path

import torch

from megastep.agents.networks.kernels.program import CUDA_FLAGS
from megastep.kernels.build.launch import BLOCK, launch
from megastep.kernels.build.program import Program

PROGRAM = Program(Path(__file__).parent, CUDA_FLAGS)
N_SUMS = 6


def run(operation: str, device: torch.device, n_threads: int, **fields) -> None:
    """Launches an operation. A tensor stands for its address, None for null."""
    values = {
        name: field.data_ptr() if isinstance(field, torch.Tensor) else 0 if field is None else field
        for name, field in fields.items()
    }
    pack = getattr(PROGRAM.params, PROGRAM.cuda_operations[operation])
    launch(PROGRAM, operation, pack(**values), device, n_threads)


def n_blocks(n_threads: int) -> int:
    """Returns the number of blocks of a launch."""
    return -(-n_threads // BLOCK)
