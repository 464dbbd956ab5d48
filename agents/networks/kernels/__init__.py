"""The recurrent cores' kernels for the GPU (:mod:`~megastep.agents.networks.kernels.program`), and what launches
them, a module per core.
"""
