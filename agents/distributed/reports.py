"""Combines the ranks' numbers for a report, on the host. Each function waits for the other ranks.

Tensors are exchanged on their device: between GPUs this is ten times as fast as on the host, and
training waits for reports.
"""

from __future__ import annotations

import math
from typing import TypeVar

import torch

from megastep.agents.distributed.pooling import all_gather, on_all_ranks
from megastep.agents.distributed.process_group import gather_objects, n_ranks, waiting

T = TypeVar("T")


def sum_over_ranks(values: torch.Tensor) -> torch.Tensor:
    """Returns the sum of the ranks' tensors, float64 on the host. Synchronises."""
    with waiting():
        return all_gather(values.double()).sum(0).cpu()


def mean_over_ranks(values: dict[str, float]) -> dict[str, float]:
    """Averages numbers over the ranks, by name.

    NaN is ignored; a number that is NaN on all ranks is left out.
    """
    rows, means = gather_objects(values), {}
    for name in values:
        column = [row[name] for row in rows if not math.isnan(row.get(name, math.nan))]
        if column:
            means[name] = math.fsum(column) / len(column)
    return means


def gather_if_any(value: T, is_needed: bool, device: torch.device) -> list[T]:
    """Returns the values of all ranks if any rank needs them, otherwise only this rank's.

    Args:
        value: small and picklable.
        is_needed: this rank needs the values.
        device: device on which the ranks exchange `is_needed`. Synchronises.
    """
    if n_ranks() == 1:
        return [value]
    with waiting():
        nobody_needs_them = bool(on_all_ranks(torch.tensor(not is_needed, device=device)))
    return [value] if nobody_needs_them else gather_objects(value)
