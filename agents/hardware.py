"""The device that a program uses, and the threads of a CPU."""

import torch

from megastep import devices
from megastep.agents.errors import user_errors


def make_device(name: str) -> torch.device:
    """Returns the device `auto`, `cpu`, `cuda`, of which each rank has its own, or `cuda:1`, and
    makes a GPU the current one. Raises UserError if there is none.
    """
    from megastep.agents.distributed import environment  # who acts has no ranks

    with user_errors(kinds=(ValueError, devices.EngineError)):
        info = environment.rank_info()
        if info and (name == "cuda" or (name == "auto" and torch.cuda.is_available())):
            name = f"cuda:{info.local_rank}"
        device = devices.device(name)
    if device.type == "cuda":
        torch.cuda.set_device(device)  # on which graphs are captured
    return device


def share_threads(width: int) -> None:
    """Gives the engine all threads of the CPU, and PyTorch one per 128 units of a layer."""
    n_threads = devices.threads()
    devices.set_threads(n_threads)
    torch.set_num_threads(max(1, min(n_threads, width // 128)))
