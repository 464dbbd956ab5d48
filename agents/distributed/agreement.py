"""Calls that succeed or fail on all ranks: an error on one rank is raised on every rank.

Each function waits for the other ranks. In a single process it just calls its argument.
"""

import pickle
from collections.abc import Callable
from typing import TypeVar, cast

from megastep.agents.distributed.process_group import (
    exchange,
    gather_objects,
    n_ranks,
    rank,
    rank_label,
)

T = TypeVar("T")


def any_rank(condition: bool) -> bool:
    """Returns whether a condition is true on any rank."""
    return any(is_true for (is_true,) in exchange([condition]))


def together(function: Callable[[], T]) -> T:
    """Calls a function on every rank. Returns this rank's result.

    Args:
        function: must not wait for other ranks.

    Raises:
        Exception: on all ranks, the error of the first rank that failed. Unless that is rank 0, its
            label is in the message.
    """
    if n_ranks() == 1:
        return function()
    value = failure = None
    try:
        value = function()
    except Exception as error:
        failure = error
    failures = gather_objects(_portable(failure))
    for number, first in enumerate(failures):
        if first is not None:
            raise first if failure is None or number != rank() else failure
    return cast(T, value)


def from_rank_0(function: Callable[[], T]) -> T:
    """Calls a function on rank 0. Returns its result, or raises its error, on every rank.

    Args:
        function: returns a small value that can be pickled.
    """
    values = gather_objects(together(lambda: function() if rank() == 0 else None))
    return cast(T, values[0])


def _portable(error) -> Exception | None:
    """Returns an error that can be pickled, None for None. Adds the label of ranks other than 0."""
    if error is None:
        return None
    if rank() > 0 and len(error.args) == 1 and isinstance(error.args[0], str):
        error.args = (f"{rank_label()}: {error.args[0]}",)
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{rank_label()}: {type(error).__name__}: {error}")
    return error
