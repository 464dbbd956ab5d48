"""Joins the process group, and exchanges values between its ranks on the host.

torchrun, or `ranks=` on the command line, starts the ranks and sets their environment variables.

R ranks.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import datetime
import faulthandler
import functools
import itertools
import json
import os
import secrets
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import distributed

from megastep.agents.distributed.environment import hostname, rank_info

if TYPE_CHECKING:
    from torch.distributed import Store, TCPStore  # pyright: ignore[reportPrivateImportUsage]

T = TypeVar("T")

#: Seconds within which all ranks must have started, the store must answer if torchrun has started
#: it, and a rank must have left.
START_SECONDS, CONNECT_SECONDS, STOP_SECONDS = 300.0, 50.0, 30.0

#: Limit of an operation. A rank may evaluate or write files for long: `watch` finds those that are
#: lost.
LONGEST_WAIT = datetime.timedelta(days=1)

#: Counts the starts of this process, equally on all ranks.
_STARTS = itertools.count()


class RankLost(RuntimeError):
    """Another rank has ended or does not answer."""


@dataclasses.dataclass
class Heartbeat:
    """The progress of a rank, which `watch` compares.

    Attributes:
        host: name of its machine.
        number: counts heartbeats.
        n_operations: collective operations started.
        n_updates: updates that the ranks have agreed to start.
        n_phases: phases of updates that the GPU has finished.
        is_exempt: True while the others wait for this rank without limit, as during an evaluation.
        is_waiting: True while it waits for the others.
        has_left: True once it is done and no longer monitored.
    """

    host: str
    number: int = 0
    n_operations: int = 0
    n_updates: int = 0
    n_phases: int = 0
    is_exempt: bool = False
    is_waiting: bool = False
    has_left: bool = False

    def finish_phase(self) -> None:
        self.n_phases += 1


counts = Heartbeat(hostname())


@contextlib.contextmanager
def _flagged(name: str) -> Iterator[None]:
    before = getattr(counts, name)
    setattr(counts, name, True)
    try:
        yield
    finally:
        setattr(counts, name, before)


def unhurried() -> contextlib._GeneratorContextManager[None]:
    """Lets the other ranks wait for this one without limit, for example while it evaluates.

    Otherwise a rank counts as hung once the others have waited `watch.HUNG_SECONDS` for it.
    """
    return _flagged("is_exempt")


def waiting() -> contextlib._GeneratorContextManager[None]:
    """Wraps a wait for other ranks. If all ranks wait for `watch.HUNG_SECONDS` in the same
    operation, they cannot reach each other.
    """
    return _flagged("is_waiting")


def start() -> None:
    """Joins the ranks that torchrun started; returns when all have joined. A no-op in a single
    process, or if this one has joined already.

    Raises:
        RuntimeError, ValueError: the ranks cannot connect.
    """
    info = rank_info()
    if info is None or distributed.is_initialized():
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    # a new prefix: after a restart the store may still hold addresses of the ended ranks
    keys = store(f"ranks {meeting.name or info.attempt} {next(_STARTS)}")
    options: dict = dict(rank=info.rank, world_size=info.n_ranks, timeout=LONGEST_WAIT)
    with waiting():
        distributed.init_process_group(backend, store=keys, **options)
    atexit.register(stop)  # gloo threads must not outlive the interpreter


def stop() -> None:
    """Leaves the process group. If that takes longer than `STOP_SECONDS`, the process ends with
    exit code 1, whatever blocks it: there is nothing left to save.
    """
    if distributed.is_initialized():
        with open(os.devnull, "w") as nowhere:
            faulthandler.dump_traceback_later(STOP_SECONDS, file=nowhere, exit=True)
            distributed.destroy_process_group()
            faulthandler.cancel_dump_traceback_later()


@functools.cache
def _store() -> Store:
    """Returns the ranks' key-value store, which whoever started the ranks hosts, or else rank 0."""
    info = rank_info()
    return _connection(info is not None and info.rank == 0 and not _has_agent())


def _has_agent() -> bool:
    return os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"


def _connection(is_master=False) -> TCPStore:
    return distributed.TCPStore(  # pyright: ignore[reportPrivateImportUsage]
        os.environ["MASTER_ADDR"],
        int(os.environ["MASTER_PORT"]),
        is_master=is_master,
        timeout=datetime.timedelta(seconds=CONNECT_SECONDS if _has_agent() else START_SECONDS),
        wait_for_workers=False,
    )


def store(name: str, is_shared: bool = True) -> Store:
    """Returns the ranks' key-value store.

    Args:
        name: prefix of its keys.
        is_shared: uses the connection of this process. False opens one for another thread.
    """
    keys = _store()  # where rank 0 hosts it, it must do so first
    job = os.environ.get("TORCHELASTIC_RUN_ID", "")  # torchrun's --rdzv-id, or a random name
    return distributed.PrefixStore(  # pyright: ignore[reportPrivateImportUsage]
        f"megastep {job} {name}", keys if is_shared else _connection()
    )


class Meeting:
    """Finds a name for this start of the ranks, the same on all of them and no earlier one's.

    torchrun's count of restarts is none: each machine counts those that its own ranks caused.

    Attributes:
        name: the name, once it is known.
    """

    def __init__(self) -> None:
        self.name: str | None = None
        self._own = secrets.token_hex(8)

    def poll(self) -> str | None:
        """Returns the name, or None if rank 0 has not started. Rank 0 calls this until all have."""
        info = rank_info()
        assert info is not None
        keys = store("meeting")
        if self.name is None:
            keys.set(f"{info.rank}", self._own)
        if info.rank == 0:
            # the store may hold what ended ranks have left; those that start replace it
            names = (f"{rank}" for rank in range(info.n_ranks))
            everyones = [keys.get(name).decode() if keys.check([name]) else "" for name in names]
            keys.set("everyone", json.dumps(everyones))
            self.name = self._own
        elif self.name is None and keys.check(["everyone"]):
            everyones = json.loads(keys.get("everyone"))
            if self._own in everyones:
                self.name = everyones[0]
        return self.name


meeting = Meeting()


def rank() -> int:
    """Returns this process's rank, 0 to R - 1; 0 in a single process."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def n_ranks() -> int:
    """Returns R; 1 in a single process."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def local_rank() -> int | None:
    """Returns this rank's index on its machine, which is its GPU's too; None without torchrun."""
    info = rank_info()
    return info and info.local_rank


def rank_label() -> str:
    """Returns this rank's label for messages, such as `rank 1 on node-7`."""
    return f"rank {rank()} on {hostname()}"


@contextlib.contextmanager
def communicating() -> Iterator[None]:
    """Wraps a collective operation: counts it, and turns PyTorch's errors into `RankLost`."""
    counts.n_operations += 1
    try:
        with waiting():
            yield
    except RuntimeError as error:
        raise RankLost(str(error).partition("\n")[0]) from error


def exchange(numbers: Sequence[float]) -> list[list[float]]:
    """Returns the numbers of every rank, by rank. Waits for the other ranks; does not use the GPU.

    Args:
        numbers: the same count on every rank.
    """
    row = torch.tensor(numbers, dtype=torch.float64)
    if n_ranks() == 1:
        return [row.tolist()]
    rows = [torch.empty_like(row) for _ in range(n_ranks())]
    with communicating():
        distributed.all_gather(rows, row)
    return [other.tolist() for other in rows]


def gather_objects(value: T) -> list[T]:
    """Returns a small picklable value of every rank, by rank. Waits for the other ranks."""
    if n_ranks() == 1:
        return [value]
    values: list = [None] * n_ranks()
    with communicating():
        distributed.all_gather_object(values, value)
    return values


def from_rank(number: int, value: T) -> T:
    """Returns the picklable value of one rank, such as tensors of the CPU. Waits for the others."""
    if n_ranks() == 1:
        return value
    values = [value]
    with communicating():
        distributed.broadcast_object_list(values, src=number)
    return values[0]
