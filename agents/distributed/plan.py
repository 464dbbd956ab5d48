"""What every rank does next, agreed upon once per update, so that all do the same updates."""

from typing import NamedTuple

from megastep.agents.distributed.process_group import counts, exchange


class Plan(NamedTuple):
    """The next turn of the training loop.

    Attributes:
        goes_on: there is another update.
        saves: a checkpoint is saved before it.
        lr_fraction: the factor of its learning rate.
    """

    goes_on: bool
    saves: bool
    lr_fraction: float


def agree(plan: Plan, is_stopped: bool, is_behind: bool) -> Plan:
    """Returns the plan of rank 0, whose clock decides, unless another rank has a reason against it.
    Waits for the other ranks.

    Args:
        plan: this rank's.
        is_stopped: a signal stops this rank, and so all.
        is_behind: this rank still writes its part of the last checkpoint, so none is saved.
    """
    counts.n_updates += 1
    rows = exchange([*plan, is_stopped, is_behind])
    goes_on, saves, lr_fraction, *_ = rows[0]
    *_, are_stopped, are_behind = zip(*rows, strict=True)
    return Plan(
        goes_on=bool(goes_on) and not any(are_stopped),
        saves=bool(saves) and not any(are_behind),
        lr_fraction=lr_fraction,
    )
