"""Steps that all ranks take or none: an error of one is the error of all.

Each function waits for the other ranks. In a process of its own it only calls what it is given.
"""

import pickle
from collections.abc import Callable
from typing import TypeVar

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
    """Calls a function on every rank. Returns what it returns here.

    The function does not wait for other ranks.

    Raises:
        Exception: if it raises one on any rank: on all ranks that of the first, with the rank's
            place in its message if that is not rank 0.
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
    return value


def from_rank_0(function: Callable[[], T]) -> T:
    """Calls a function on rank 0. Returns what it returns, or raises its error, on every rank.

    Args:
        function: returns a small value that can be pickled.
    """
    return gather_objects(together(lambda: function() if rank() == 0 else None))[0]


def _portable(error):
    """Returns an error that can be pickled, None for None; that of another rank than 0 begins with
    the rank's place.
    """
    if error is None:
        return None
    if rank() > 0 and len(error.args) == 1 and isinstance(error.args[0], str):
        error.args = (f"{rank_label()}: {error.args[0]}",)
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{rank_label()}: {type(error).__name__}: {error}")
    return error
