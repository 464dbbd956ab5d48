"""The ranks that train one policy together, and what they exchange on the host."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import torch

from megastep.agents.distributed import agreement, process_group
from megastep.agents.distributed.pooling import all_gather

T = TypeVar("T")


class Ranks(NamedTuple):
    """This process among the ranks that train one policy. Methods wait for the other ranks.

    Attributes:
        rank: its number, 0 to n - 1.
        n: 1 for a process that trains a policy by itself, whether or not others train theirs.
    """

    rank: int = 0
    n: int = 1

    def exchange(self, numbers: Sequence[float]) -> list[list[float]]:
        """Returns the numbers of every rank, by rank."""
        return [[*numbers]] if self.n == 1 else process_group.exchange(numbers)

    def any(self, condition: bool) -> bool:
        """Returns whether a condition is true on any rank."""
        return any(is_true for (is_true,) in self.exchange([condition]))

    def from_first(self, function: Callable[[], T]) -> T:
        """Calls a function on rank 0. Returns its result, or raises its error, on every rank."""
        return function() if self.n == 1 else agreement.from_rank_0(function)

    def sum(self, values: torch.Tensor) -> torch.Tensor:
        """Returns the sum of the ranks' tensors, float64 on the host. Synchronises.

        They are exchanged on their device, between GPUs ten times as fast as on the host.
        """
        values = values.double()
        if self.n > 1:
            with process_group.waiting():
                values = all_gather(values).sum(0)
        return values.cpu()

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Averages numbers over the ranks, by name.

        NaN is ignored; a number that is NaN on all ranks is left out.
        """
        rows, means = [values] if self.n == 1 else process_group.gather_objects(values), {}
        for name in values:
            column = [row[name] for row in rows if not math.isnan(row.get(name, math.nan))]
            if column:
                means[name] = math.fsum(column) / len(column)
        return means

    def gather_if_any(self, value: T, is_needed: bool) -> list[T]:
        """Returns the values of all ranks if any rank needs them, otherwise only this rank's.

        Args:
            value: small and picklable.
            is_needed: this rank needs the values.
        """
        is_needed = self.any(is_needed)
        return process_group.gather_objects(value) if is_needed and self.n > 1 else [value]


#: A process that trains a policy of its own.
ONE = Ranks()


def world() -> Ranks:
    """Returns all ranks that torchrun or `ranks=` started."""
    return Ranks(process_group.rank(), process_group.n_ranks())
