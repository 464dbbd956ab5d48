"""The GPUs of this machine."""

import os


def ask_for_queues() -> None:
    """Has CUDA's driver make 32 queues for streams instead of 8, unless the user says how many: a
    population has a stream for each member, and streams that share a queue wait for each other.
    Call it before the driver starts.
    """
    os.environ.setdefault("CUDA_DEVICE_MAX_CONNECTIONS", "32")


def is_available() -> bool:
    """Returns whether PyTorch can use a GPU."""
    import torch

    ask_for_queues()  # for every command, as settings are not known yet
    return torch.cuda.is_available()


def count() -> int:
    """Returns the number of GPUs that PyTorch can use."""
    import torch

    return torch.cuda.device_count() if is_available() else 0
