"""This process's place among the ranks, as torchrun's environment variables say. Knows no PyTorch,
which takes seconds to import.
"""

import contextlib
import os
import socket
from collections.abc import Iterator, Mapping
from typing import NamedTuple

NAMES = "RANK", "WORLD_SIZE", "LOCAL_RANK"


class Launched(NamedTuple):
    """This process's place among the ranks, as torchrun says."""

    rank: int
    n_ranks: int
    local_rank: int  # among the ranks of this machine
    attempt: int = 0  # how often torchrun has started the ranks again


def launched() -> Launched | None:
    """Returns this process's place if torchrun started it, None for a process of its own.

    Raises:
        ValueError: torchrun's variables contradict each other.
    """
    if any(name not in os.environ for name in NAMES):
        return None
    texts = [os.environ[name] for name in NAMES]
    texts.append(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
    if not all(text.isdecimal() for text in texts) or int(texts[0]) >= int(texts[1]):
        variables = " ".join(f"{name}={text}" for name, text in zip(NAMES, texts))
        raise ValueError(
            f"{variables} is no rank of torchrun; to train in one process, unset these "
            "environment variables"
        )
    return Launched(*map(int, texts))


def token() -> str:
    """Returns the name of this job, by which its keys in a store begin: random where `ranks=`
    started it, and otherwise torchrun's `--rdzv-id`.
    """
    return os.environ.get("TORCHELASTIC_RUN_ID", "")


def rank() -> int:
    """Returns the number of the rank that this process is, 0 for a process of its own."""
    place = launched()
    return place.rank if place else 0


def hostname() -> str:
    return socket.gethostname()


@contextlib.contextmanager
def variables(changes: Mapping[str, str]) -> Iterator[None]:
    """Sets environment variables, also of processes that are started, for the time of this
    context.
    """
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, text in before.items():
            os.environ.pop(name, None)
            if text is not None:
                os.environ[name] = text
