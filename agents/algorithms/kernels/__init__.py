"""The algorithms' kernels for the GPU as one program."""

from pathlib import Path

from megastep.kernels.build.program import FAST_CUDA_FLAGS, Program

PROGRAM = Program(Path(__file__).parent, FAST_CUDA_FLAGS)
