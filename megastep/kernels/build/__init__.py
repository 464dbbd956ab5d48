"""Builds folders of C++ and CUDA kernels at first use, and launches them.

A folder is a :class:`~megastep.kernels.build.kernel_library.KernelLibrary`;
:func:`~megastep.kernels.build.launch.launch` runs one of its operations.
"""
