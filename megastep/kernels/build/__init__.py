"""Builds folders of C++ and CUDA kernels at first use, and launches them.

A :class:`Program` is a folder of kernels; :func:`launch` runs one of its operations.
"""

from megastep.kernels.build.compile import EngineError
from megastep.kernels.build.launch import ENGINE, launch
from megastep.kernels.build.program import Program

__all__ = ["ENGINE", "EngineError", "Program", "launch"]
