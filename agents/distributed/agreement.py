"""What ranks agree on: whether a call succeeded, and once per update what all do next.

Each function waits for the other ranks. In a single process it just calls its argument.
"""

import pickle
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, TypeVar, cast

from megastep.agents.distributed.process_group import (
    counts,
    gather_objects,
    n_ranks,
    rank,
    rank_label,
)

if TYPE_CHECKING:
    from megastep.agents.distributed.ranks import Ranks

T = TypeVar("T")


class Plan(NamedTuple):
    """The next iteration of the training loop.

    Attributes:
        goes_on: there is another update.
        saves: save a checkpoint before it.
        lr_fraction: its learning rate as a fraction of the initial one.
    """

    goes_on: bool
    saves: bool
    lr_fraction: float


def agree(plan: Plan, is_stopped: bool, is_behind: bool, ranks: "Ranks") -> Plan:
    """Returns the plan of rank 0, whose clock decides, unless a rank is stopped or behind.

    Args:
        plan: this rank's plan.
        is_stopped: this rank got a signal; all ranks stop.
        is_behind: this rank is still writing the last checkpoint, so no rank saves another.
        ranks: those that agree.
    """
    counts.n_updates += 1
    rows = ranks.exchange([*plan, is_stopped, is_behind])
    goes_on, saves, lr_fraction, *_ = rows[0]
    *_, are_stopped, are_behind = zip(*rows, strict=True)
    return Plan(
        goes_on=bool(goes_on) and not any(are_stopped),
        saves=bool(saves) and not any(are_behind),
        lr_fraction=lr_fraction,
    )


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
