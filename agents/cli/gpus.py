"""Jobs that run at the same time on one machine share its GPUs evenly."""

import contextlib
import fcntl
import itertools
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO


@contextlib.contextmanager
def one_gpu(folder: Path, number: int) -> Iterator[int | None]:
    """PyTorch's current GPU, which device=auto means, is one with the fewest jobs on it meanwhile;
    gives its index, None where there is no choice.

    Jobs know of each other by locks on files in `folder`, one for each place on each GPU of this
    machine; the system drops them when a process ends. Where files cannot be locked, job `number`
    takes the GPUs in turn.
    """
    import torch

    n_gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if n_gpus < 2:
        yield None
        return
    before = torch.cuda.current_device()
    try:
        gpu, file = _taken(folder, n_gpus)
    except OSError:
        gpu, file = number % n_gpus, contextlib.nullcontext()
    with file:
        torch.cuda.set_device(gpu)
        try:
            yield gpu
        finally:
            torch.cuda.set_device(before)


def _taken(folder: Path, n_gpus: int) -> tuple[int, TextIO]:
    """A GPU, and the open file whose lock keeps a place on it."""
    for number in itertools.count():
        place, gpu = divmod(number, n_gpus)
        file = open(folder / f"{socket.gethostname()}-gpu{gpu}-{place}", "a")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return gpu, file
        except BlockingIOError:
            file.close()
        except OSError:
            file.close()
            raise
