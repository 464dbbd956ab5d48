"""Joins the process group, and exchanges values between its ranks on the host.

torchrun, or `ranks=` on the command line, starts the ranks and sets their environment variables.
Every function that exchanges something waits for the other ranks. R ranks.
"""

import atexit
import contextlib
import datetime
import faulthandler
import functools
import itertools
import os
import pickle
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar, cast

import torch
from torch import distributed
from torch.distributed import Store, TCPStore  # pyright: ignore[reportPrivateImportUsage]

from megastep.agents.distributed.environment import hostname, rank_info

T = TypeVar("T")

#: Seconds within which the store must answer a rank that starts, and a rank must have left.
CONNECT_SECONDS, STOP_SECONDS = 50.0, 30.0
#: PyTorch's own limit of an operation, after which ranks end that wait for one that hangs.
LONGEST_WAIT = datetime.timedelta(minutes=30)
#: Counts the starts of this process, equally on all ranks.
_STARTS = itertools.count()
#: CUDA graphs with collective operations in them, for which NCCL waits before it ends.
graphs: weakref.WeakSet[torch.cuda.CUDAGraph] = weakref.WeakSet()


class RankLost(RuntimeError):
    """Another rank has ended or does not answer."""


def start() -> None:
    """Joins the ranks that torchrun started. RuntimeError or ValueError if they cannot connect."""
    info = rank_info()
    if info is None or distributed.is_initialized():
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    keys = store(f"ranks {next(_STARTS)}")
    options: dict = dict(rank=info.rank, world_size=info.n_ranks, timeout=LONGEST_WAIT)
    distributed.init_process_group(backend, store=keys, **options)
    atexit.register(stop)  # gloo threads must not outlive the interpreter


def stop() -> None:
    """Leaves the process group, after `STOP_SECONDS` by ending this process."""
    if distributed.is_initialized():
        with open(os.devnull, "w") as nowhere:
            faulthandler.dump_traceback_later(STOP_SECONDS, file=nowhere, exit=True)
            for graph in graphs:
                graph.reset()
            distributed.destroy_process_group()
            faulthandler.cancel_dump_traceback_later()


@functools.cache
def _store() -> Store:
    """Returns the ranks' key-value store, which whoever started the ranks hosts, or else rank 0."""
    info = rank_info()
    has_agent = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    return _connection(info is not None and info.rank == 0 and not has_agent)


def _connection(is_master=False) -> TCPStore:
    return TCPStore(
        os.environ["MASTER_ADDR"],
        int(os.environ["MASTER_PORT"]),
        is_master=is_master,
        timeout=datetime.timedelta(seconds=CONNECT_SECONDS),
        wait_for_workers=False,
    )


def store(name: str, is_shared: bool = True) -> Store:
    """Returns the ranks' key-value store with a prefix, over a shared connection or another."""
    keys, info = _store(), rank_info()  # where rank 0 hosts it, it must do so first
    job = os.environ.get("TORCHELASTIC_RUN_ID", "")  # torchrun's --rdzv-id, or a random name
    return distributed.PrefixStore(  # pyright: ignore[reportPrivateImportUsage]
        f"megastep {job} {info and info.attempt} {name}", keys if is_shared else _connection()
    )


def rank() -> int:
    """Returns this process's rank, 0 to R - 1; 0 in a single process."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def n_ranks() -> int:
    """Returns R; 1 in a single process."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank_label() -> str:
    """Returns this rank's label for messages, such as `rank 1 on node-7`."""
    return f"rank {rank()} on {hostname()}"


@contextlib.contextmanager
def communicating() -> Iterator[None]:
    """Turns what PyTorch raises in a collective operation into `RankLost`."""
    try:
        yield
    except RuntimeError as error:
        raise RankLost(str(error).partition("\n")[0]) from error


def exchange(numbers: Sequence[float]) -> list[list[float]]:
    """Returns the numbers of every rank, equally many of each, by rank, without the GPU."""
    row = torch.tensor(numbers, dtype=torch.float64)
    if n_ranks() == 1:
        return [row.tolist()]
    rows = [torch.empty_like(row) for _ in range(n_ranks())]
    with communicating():
        distributed.all_gather(rows, row)
    return [other.tolist() for other in rows]


def gather_objects(value: T) -> list[T]:
    """Returns a small picklable value of every rank, by rank."""
    if n_ranks() == 1:
        return [value]
    values: list = [None] * n_ranks()
    with communicating():
        distributed.all_gather_object(values, value)
    return values


def from_rank(number: int, value: T) -> T:
    """Returns the picklable value of one rank, such as tensors of the CPU."""
    if n_ranks() == 1:
        return value
    values = [value]
    with communicating():
        distributed.broadcast_object_list(values, src=number)
    return values[0]


def together(function: Callable[[], T]) -> T:
    """Calls a function, which waits for no other rank, on every rank. Returns this rank's result,
    or raises on all the error of the first that failed, with its label unless that is rank 0.
    """
    if n_ranks() == 1:
        return function()
    value = failure = None
    try:
        value = function()
    except Exception as error:
        failure = error
    for number, first in enumerate(gather_objects(_portable(failure))):
        if first is not None:
            raise first if failure is None or number != rank() else failure
    return cast(T, value)


def from_rank_0(function: Callable[[], T]) -> T:
    """Calls a function on rank 0. Returns its picklable result, or raises its error, on all."""
    values = gather_objects(together(lambda: function() if rank() == 0 else None))
    return cast(T, values[0])


def _portable(error) -> Exception | None:
    """Returns an error that can be pickled, with the label of ranks other than 0; None for None."""
    if error is None:
        return None
    if rank() > 0 and len(error.args) == 1 and isinstance(error.args[0], str):
        error.args = (f"{rank_label()}: {error.args[0]}",)
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{rank_label()}: {type(error).__name__}: {error}")
    return error
