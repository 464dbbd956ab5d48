"""The recurrent cores' kernels for the GPU (:mod:`~agents.kernels.program`), and what launches
them, a module per core.
"""
