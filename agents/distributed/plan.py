"""Agrees once per update on what all ranks do next, so that all do the same updates."""

from typing import NamedTuple

from megastep.agents.distributed.process_group import counts, exchange


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


def agree(plan: Plan, is_stopped: bool, is_behind: bool) -> Plan:
    """Returns the plan of rank 0, whose clock decides, unless a rank is stopped or behind.

    Waits for the other ranks, those that train other members of a population included.

    Args:
        plan: this rank's plan.
        is_stopped: this rank got a signal; all ranks stop.
        is_behind: this rank is still writing the last checkpoint, so no rank saves another.
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
