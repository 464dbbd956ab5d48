"""Kernels of a policy's forward pass that need neither PyTorch nor a GPU, for web pages."""

from pathlib import Path

from megastep.kernels.build.kernel_library import KernelLibrary

__all__ = ["LIBRARY"]

LIBRARY = KernelLibrary(Path(__file__).parent)
