"""The processes that train together: who they are, and what they tell each other on the host.

torchrun, or `ranks=` on the command line, starts them and sets their environment variables.

R ranks.
"""

from __future__ import annotations

import contextlib
import datetime
import math
import os
import socket
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import distributed

#: Seconds within which all ranks must have started.
START_SECONDS = 300.0


class RankLost(RuntimeError):
    """Another rank has ended, or does not answer."""


class Launched(NamedTuple):
    """This process's place among the ranks, as torchrun says."""

    rank: int
    n_ranks: int
    local_rank: int  # among the ranks of this machine


def launched() -> Launched | None:
    """Returns this process's place if torchrun started it, None for a process of its own."""
    names = "RANK", "WORLD_SIZE", "LOCAL_RANK"
    if any(name not in os.environ for name in names):
        return None
    return Launched(*(int(os.environ[name]) for name in names))


def start(seconds: float = START_SECONDS) -> None:
    """Joins the ranks that torchrun started. Returns when all have. Does nothing in a process of
    its own.
    """
    if launched() is None or distributed.is_initialized():
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    distributed.init_process_group(backend, timeout=datetime.timedelta(seconds=seconds))


def stop() -> None:
    """Leaves the other ranks."""
    if distributed.is_initialized():
        distributed.destroy_process_group()


def rank() -> int:
    """Returns this process's number, 0 to R - 1; 0 without other ranks."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def n_ranks() -> int:
    """Returns R; 1 without other ranks."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def hostname() -> str:
    return socket.gethostname()


def place() -> str:
    """Returns this rank's place for messages, such as `rank 1 on node-7`."""
    return f"rank {rank()} on {hostname()}"


@contextlib.contextmanager
def communicating() -> Iterator[None]:
    """Turns an error of PyTorch's communication into `RankLost`."""
    try:
        yield
    except RuntimeError as error:
        raise RankLost(str(error).partition("\n")[0]) from error


def exchange(numbers: Sequence[float]) -> list[list[float]]:
    """Returns the numbers of every rank, in the order of ranks. Waits for the others; touches no
    GPU.

    Args:
        numbers: as many from every rank.
    """
    row = torch.tensor(numbers, dtype=torch.float64)
    if n_ranks() == 1:
        return [row.tolist()]
    rows = [torch.empty_like(row) for _ in range(n_ranks())]
    with communicating():
        distributed.all_gather(rows, row)
    return [other.tolist() for other in rows]


def gather_objects(value: Any) -> list[Any]:
    """Returns a small value of every rank, in the order of ranks. Waits for the others."""
    if n_ranks() == 1:
        return [value]
    values = [None] * n_ranks()
    with communicating():
        distributed.all_gather_object(values, value)
    return values


def sum_over_ranks(values: torch.Tensor) -> torch.Tensor:
    """Returns the sum of the ranks' tensors, float64 on the host. Synchronises, and waits for the
    others.
    """
    if n_ranks() == 1:
        return values.double().cpu()
    rows = torch.tensor(exchange(values.flatten().tolist()), dtype=torch.float64)
    return rows.sum(0).view(values.shape)


def mean_over_ranks(values: dict[str, float]) -> dict[str, float]:
    """Returns the means over the ranks of numbers by name. Waits for the others.

    NaN does not count; a number that is NaN on all ranks is left out.
    """
    rows, means = gather_objects(values), {}
    for name in values:
        column = [row[name] for row in rows if not math.isnan(row.get(name, math.nan))]
        if column:
            means[name] = math.fsum(column) / len(column)
    return means
