"""The networks' kernels, and a module per core that launches those for the GPU."""
