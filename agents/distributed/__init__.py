"""Data-parallel training of one policy, on GPUs of one or several machines, or on CPUs. A *rank*
is one of the processes, as in PyTorch and NCCL. Each rank has its own environments.

All ranks hold the same weights. Gradients, and all statistics that weights depend on, are pooled
over the ranks; rank 0 decides what depends on the clock. In a single process the functions of this
package are no-ops.
"""
