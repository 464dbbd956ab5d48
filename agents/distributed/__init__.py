"""Several processes that train one policy, each with environments of its own: on the GPUs of one
machine, on those of several, or on CPUs. A *rank* is one of them, as in PyTorch and NCCL.

Every rank holds the same weights. Gradients, and every statistic that a weight depends on, are
pooled over the ranks; what depends on a clock is decided by rank 0. In one process all of this does
nothing, and costs nothing.
"""
