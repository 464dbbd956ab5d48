"""The kernel library of the algorithms, for GPUs."""

from pathlib import Path

from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary

LIBRARY = KernelLibrary(Path(__file__).parent, FAST_CUDA_FLAGS)
