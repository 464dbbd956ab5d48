"""Builds folders of C++ and CUDA kernels at first use, and launches them."""
