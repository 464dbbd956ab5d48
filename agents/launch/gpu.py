"""The GPUs of this machine."""

import os


def ask_for_queues() -> None:
    """Has the driver, before it starts, make a queue for each member's stream, not 8 for all."""
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
