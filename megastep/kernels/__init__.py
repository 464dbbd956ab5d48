"""The kernels: C++ and CUDA sources, and :mod:`~megastep.kernels.compile`, which builds them at
first use.
"""
