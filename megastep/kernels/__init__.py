"""The engine's kernels in C++ and CUDA. All kernel libraries use the headers in ``common/``."""
