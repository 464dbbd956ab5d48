"""Devices by name, whether what is to be made fits into their memory, and how many threads of the
CPU the engine takes.
"""

from typing import Any

import torch

from megastep.kernels.build.compile import EngineError

__all__ = ["device", "fit", "free_memory", "set_threads", "threads"]

_n_threads = None  # None: as many as PyTorch


def device(name: str | torch.device = "auto") -> torch.device:
    """The device called ``name``: auto (a GPU if there is one), cpu, cuda, cuda:1. EngineError if
    it is not there.
    """
    if name == "auto":
        return (
            torch.device("cuda", torch.cuda.current_device())
            if torch.cuda.is_available()
            else torch.device("cpu")
        )
    try:
        chosen = torch.device(name)
    except (RuntimeError, TypeError):
        chosen = None
    if chosen is None or chosen.type not in ("cpu", "cuda"):
        raise EngineError(f"device={name} is unknown: use auto, cpu, cuda, or cuda: and a number.")
    if chosen.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (chosen.index or 0) >= count:
            raise EngineError(
                f"device={name} was given, but {_missing(count)}: use device=auto or device=cpu."
            )
        return torch.device("cuda", chosen.index or 0)
    return chosen


def _missing(count):
    if count:
        return f"there are {count} GPUs"
    built = "" if torch.version.cuda else " and this PyTorch is built for the CPU only"
    return f"PyTorch sees no GPU{built}"


def threads() -> int:
    """How many threads an operation of the engine takes on the CPU: what :func:`set_threads` was
    given, else as many as PyTorch's operations.
    """
    return _n_threads or torch.get_num_threads()


def set_threads(n: int | None) -> None:
    """Gives the engine a number of threads of its own, or with None PyTorch's."""
    global _n_threads
    _n_threads = n


def fit(n_envs: int, bytes_each: float, device: Any, what: str = "environments") -> None:
    """EngineError, with the number that fits, if ``n_envs`` things of ``bytes_each`` bytes are too
    many for the memory that is free on ``device``.
    """
    free = free_memory(device)
    if n_envs * bytes_each > 0.95 * free:
        raise EngineError(
            f"{n_envs:,} {what} need {n_envs * bytes_each / 1e9:.1f} GB, but {free / 1e9:.1f} GB "
            f"are free on {device}: at most {int(0.95 * free / bytes_each):,} fit."
        )


def free_memory(device: Any) -> int:
    """Bytes that can still be allocated on ``device``."""
    device = torch.device(device)
    if device.type == "cuda":
        return (
            torch.cuda.mem_get_info(device)[0]
            + torch.cuda.memory_reserved(device)
            - torch.cuda.memory_allocated(device)
        )
    try:
        with open("/proc/meminfo") as file:
            return next(
                int(line.split()[1]) * 1024 for line in file if line.startswith("MemAvailable")
            )
    except (OSError, StopIteration):
        return 1 << 62
