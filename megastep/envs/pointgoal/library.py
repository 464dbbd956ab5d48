"""The kernel library of PointGoal."""

from pathlib import Path

from megastep.kernels.build.kernel_library import KernelLibrary

__all__ = ["LIBRARY"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
