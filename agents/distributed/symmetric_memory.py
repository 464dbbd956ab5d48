"""Sums over the GPUs of one machine, each of which reads and writes the others' memory: half as
long as NCCL's.

The interface of PyTorch's symmetric memory is private, so no other file uses it. Wherever it cannot
be set up, NCCL takes its place.
"""

import contextlib
import os
import threading
from pathlib import Path

import torch
from torch import distributed

from megastep.agents.distributed.environment import hostname
from megastep.agents.distributed.process_group import communicating, gather_objects

#: Larger buffers are NCCL's, in bytes.
MAX_BYTES = 2**26
#: Seconds within which the ranks must have opened each other's memory.
SETUP_SECONDS = 20.0
#: PyTorch copies the path of a socket in this folder into 108 bytes, unchecked.
_MAX_PATH = 80
#: By length and device; None where NCCL is used.
_buffers: dict[tuple[int, torch.device], torch.Tensor | None] = {}


def buffer(n: int, device: torch.device) -> torch.Tensor | None:
    """Returns the buffer of this length that `all_reduce_` sums, or None if NCCL must.

    All ranks make the same calls, and get a buffer or None alike. The first call for a length waits
    for the other ranks; it returns None while a CUDA graph is recorded.

    Args:
        n: its length, a multiple of 4.
        device: the GPU of this rank.

    Returns:
        (n,) float32, the same tensor at each call.
    """
    key = n, device
    if key not in _buffers:
        if torch.cuda.is_current_stream_capturing():
            return None
        _buffers[key] = _set_up(n, device)
    return _buffers[key]


def all_reduce_(buffer: torch.Tensor) -> None:
    """Sums a `buffer` over the ranks, in place, in one kernel on the current stream.

    Unlike an operation of NCCL, it may be part of a CUDA graph: each of its blocks waits for the
    block of the same number on the other GPUs alone, and all ranks launch these sums in the same
    order on one stream, so nothing that the others run before a sum waits for a rank that is in it.

    One GPU sums a number, in the order of the ranks, and writes it to all. So results are
    deterministic and equal on all ranks, and with two ranks they have NCCL's bits.
    """
    with communicating():
        _sum(buffer)


def _sum(buffer) -> None:
    group = distributed.group.WORLD
    assert group is not None
    with torch.cuda.device(buffer.device):
        torch.ops.symm_mem.two_shot_all_reduce_(buffer, "sum", group.group_name)


def _set_up(n, device) -> torch.Tensor | None:
    memory = _allocate(n, device)
    everyones = gather_objects((_machine(), memory is not None))
    if memory is None or set(everyones) != {(_machine(), True)}:
        return None
    is_open = threading.Event()

    def open_all() -> None:
        with contextlib.suppress(Exception):  # of any kind, from a version of PyTorch or a driver
            # Launches no kernel. Python's `rendezvous` would hold its lock, and stop heartbeats.
            _sum(memory[:0])
            is_open.set()

    # in a thread, as a rank that fails leaves the others waiting in PyTorch's code
    thread = threading.Thread(target=open_all, daemon=True)
    thread.start()
    thread.join(SETUP_SECONDS)
    return memory if all(gather_objects(is_open.is_set())) else None


def _allocate(n, device) -> torch.Tensor | None:
    """Returns the memory, or None if this rank cannot use symmetric memory."""
    folders = [os.environ.get(name, "") for name in ("TMPDIR", "TMP", "TEMP", "TEMPDIR")]
    is_refused = os.environ.get("NCCL_P2P_DISABLE", "0") != "0"  # GPUs cannot reach each other
    if 4 * n > MAX_BYTES or is_refused or max(map(len, folders)) > _MAX_PATH:
        return None
    # multicast is not used, and on some machines fails
    os.environ.setdefault("TORCH_SYMM_MEM_DISABLE_MULTICAST", "1")
    try:
        from torch._C._distributed_c10d import _SymmetricMemory

        # PyTorch's `empty` may put several buffers into one allocation
        return _SymmetricMemory.empty_strided_p2p((n,), (1,), torch.float32, device)
    except Exception:  # as above
        return None


def _machine() -> tuple[str, str]:
    """Returns what is equal for the processes of one machine alone."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    return hostname(), boot.read_text() if boot.exists() else ""
