"""The engine's kernels in C++ and CUDA: one operation is a ``.h``, a ``.cpp`` and a ``.cu`` file.

Headers in ``common/`` are for all programs. :mod:`~megastep.kernels.build` builds and launches
them.
"""
