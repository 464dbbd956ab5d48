"""The LSTM's kernels for the GPU, and :mod:`~agents.kernels.lstm`, which launches them."""
