"""The processes that train together: who they are, and what they tell each other on the host.

torchrun, or `ranks=` on the command line, starts them and sets their environment variables.

R ranks.
"""

from __future__ import annotations

import atexit
import contextlib
import datetime
import functools
import itertools
import os
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import distributed

from megastep.agents.distributed.environment import hostname, launched, token

#: Seconds within which all ranks must have started.
START_SECONDS = 300.0


class RankLost(RuntimeError):
    """Another rank has ended, or does not answer."""


class Counts:
    """What this rank has done, for `watch` to compare.

    Attributes:
        n_operations: number of operations of all ranks that it has begun.
        n_updates: number of updates that the ranks have agreed to begin.
        is_exempt: it does something for which the others wait, however long it takes.
    """

    n_operations = n_updates = 0
    is_exempt = False


counts = Counts()


@contextlib.contextmanager
def unhurried() -> Iterator[None]:
    """In this context the other ranks wait for this one as long as it takes: an evaluation, files.

    Otherwise a rank that the others have waited for, for `watch.LOST_SECONDS`, counts as hung.
    """
    counts.is_exempt, before = True, counts.is_exempt
    try:
        yield
    finally:
        counts.is_exempt = before


def start(seconds: float = START_SECONDS) -> None:
    """Joins the ranks that torchrun started. Returns when all have. Does nothing in a process of
    its own.
    """
    place = launched()
    if place is None or distributed.is_initialized():
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    wait = datetime.timedelta(seconds=seconds)
    # torchrun may keep the store when it starts the ranks again, with addresses of the dead in it
    name = f"ranks {token()} {place.attempt} {next(_STARTS)}"
    keys = distributed.PrefixStore(name, _store())
    distributed.init_process_group(
        backend, store=keys, rank=place.rank, world_size=place.n_ranks, timeout=wait
    )
    atexit.register(stop)  # threads of gloo that still run would abort the interpreter's end


_STARTS = itertools.count()


@functools.cache
def _store() -> distributed.Store:
    """Returns the key-value store of the ranks, which torchrun's agent has, or else rank 0."""
    place, has_agent = launched(), os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    return _connection(is_master=place.rank == 0 and not has_agent)


def _connection(is_master=False):
    return distributed.TCPStore(
        os.environ["MASTER_ADDR"],
        int(os.environ["MASTER_PORT"]),
        is_master=is_master,
        timeout=datetime.timedelta(seconds=START_SECONDS),
        wait_for_workers=False,
    )


def store(name: str) -> distributed.Store:
    """Returns a connection of its own to the ranks' key-value store: no other thread waits on it.

    Args:
        name: of a set of keys.
    """
    return distributed.PrefixStore(f"megastep {token()} {name}", _connection())


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


def local_rank() -> int | None:
    """Returns this rank's number on its machine, which is that of its GPU; None without ranks."""
    place = launched()
    return place and place.local_rank


def place() -> str:
    """Returns this rank's place for messages, such as `rank 1 on node-7`."""
    return f"rank {rank()} on {hostname()}"


@contextlib.contextmanager
def communicating() -> Iterator[None]:
    """An operation of all ranks, which is counted. An error of PyTorch's becomes `RankLost`."""
    counts.n_operations += 1
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
