"""The engine's kernels in C++ and CUDA: one operation is a ``.h``, a ``.cpp`` and a ``.cu`` file.

All kernel libraries use the headers in ``common/``. :mod:`~megastep.kernels.build` builds and
launches kernels.
"""
