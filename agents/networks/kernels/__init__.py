"""The recurrent cores' kernels for the GPU, and a module per core that launches them."""
