"""Devices by name, their free memory, and the number of CPU threads."""

import contextlib
import functools
import os
import socket
import warnings

import torch

from megastep.kernels.build.compile import EngineError
from megastep.kernels.build.launch import BLOCK

#: GNU OpenMP ends the process if it cannot start as many as it is asked for.
MAX_THREADS = max(1024, os.cpu_count() or 1)
_n_threads = None  # None: as many as PyTorch


def device(name: str | torch.device = "auto") -> torch.device:
    """Returns a device: auto (a GPU if there is one), cpu, cuda or cuda:1. EngineError if none."""
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda", torch.cuda.current_device()) if count else torch.device("cpu")
    try:
        requested = torch.device(name)
    except (RuntimeError, TypeError):
        requested = torch.device("meta")
    if requested.type == "cpu":
        return requested
    if requested.type != "cuda":
        raise EngineError(f"device={name} is unknown: use auto, cpu, cuda, or cuda: and a number.")
    if (requested.index or 0) < count:
        return torch.device("cuda", requested.index or 0)
    missing = f"there are {count} GPUs"
    if not count:
        missing = f"PyTorch sees no GPU on {socket.gethostname()}"
        missing += "" if torch.version.cuda else " and this PyTorch is built for the CPU only"
        if job := os.environ.get("SLURM_JOB_ID"):
            missing += f", and job {job} of Slurm may have been given none (--gpus-per-node=1)"
    raise EngineError(f"device={name} was given, but {missing}: use device=auto or device=cpu.")


def threads() -> int:
    """Returns the number of CPU threads per operation. Default: as many as PyTorch uses."""
    n = _n_threads or torch.get_num_threads()
    if n > 1 and "OMP_WAIT_POLICY" not in os.environ:  # set by megastep, unless torch came first
        _warn_of_spinning()
    return n


@functools.cache
def _warn_of_spinning() -> None:
    """Warns once that threads spin while they wait."""
    warnings.warn(
        "torch was imported before megastep, so threads that wait keep their cores busy, and steps "
        "on a CPU that does anything else are many times slower; import megastep first, or set "
        "OMP_WAIT_POLICY=passive in the environment",
        RuntimeWarning,
        stacklevel=2,
    )


def set_threads(n: int | None) -> None:
    """Sets the CPU threads per operation, 1 to `MAX_THREADS`; None: as many as PyTorch uses."""
    global _n_threads
    if n is not None and (type(n) is not int or not 1 <= n <= MAX_THREADS):
        raise ValueError(f"n must be an integer from 1 to {MAX_THREADS}, but {n!r} was given")
    _n_threads = n


def fit(n: int, bytes_each: float, device: torch.device | str, what: str = "environments") -> None:
    """Raises EngineError, which says how many fit, if ``n`` things of ``bytes_each`` bytes do not
    fit into the free memory of ``device``.
    """
    free = free_memory(device)
    if n * bytes_each > 0.95 * free:
        raise EngineError(
            f"{n:,} {what} need {n * bytes_each / 1e9:.1f} GB, but {0.95 * free / 1e9:.1f} GB of "
            f"the {free / 1e9:.1f} GB that are free on {device} may be used: at most "
            f"{int(0.95 * free / bytes_each):,} fit."
        )


def free_memory(device: torch.device | str) -> int:
    """Returns the number of bytes that can still be allocated on ``device``."""
    device = torch.device(device)
    if device.type == "cuda":
        return (
            torch.cuda.mem_get_info(device)[0]
            + torch.cuda.memory_reserved(device)
            - torch.cuda.memory_allocated(device)
        )
    with contextlib.suppress(OSError, StopIteration), open("/proc/meminfo") as file:
        line = next(line for line in file if line.startswith("MemAvailable"))
        return int(line.split()[1]) * 1024
    return 1 << 62


@functools.cache
def n_resident_threads(device: torch.device, n_blocks: int | None = None) -> int:
    """Returns how many threads a GPU can run at once, if a multiprocessor holds at most
    ``n_blocks`` blocks of a kernel; 0 for a CPU.
    """
    if device.type == "cpu":
        return 0
    gpu = torch.cuda.get_device_properties(device)
    n_threads = gpu.max_threads_per_multi_processor
    if n_blocks is not None:
        n_threads = min(n_threads, n_blocks * BLOCK)
    return gpu.multi_processor_count * n_threads
