"""The ranks that train one policy: what they exchange on the host and agree on per update."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

import torch

from megastep.agents.distributed import process_group
from megastep.agents.distributed.pooling import all_gather
from megastep.agents.errors import UserError

T = TypeVar("T")

#: Integer dtype of each item size, to view the bits of floats.
INTEGERS = {1: torch.int8, 2: torch.int16, 4: torch.int32, 8: torch.int64}


class Plan(NamedTuple):
    """The next iteration of the training loop."""

    goes_on: bool  # there is another update
    saves: bool  # save a checkpoint before it
    lr_fraction: float  # its learning rate as a fraction of the initial one


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

    def agree(self, plan: Plan, is_stopped: bool, is_behind: bool) -> Plan:
        """Returns the plan of rank 0, whose clock decides. All ranks stop if one is stopped by a
        signal, and none saves if one is still writing the last checkpoint.
        """
        rows = self.exchange([*plan, is_stopped, is_behind])
        goes_on, saves, lr_fraction, *_ = rows[0]
        *_, are_stopped, are_behind = zip(*rows, strict=True)
        return Plan(
            goes_on=bool(goes_on) and not any(are_stopped),
            saves=bool(saves) and not any(are_behind),
            lr_fraction=lr_fraction,
        )

    def any(self, condition: bool) -> bool:
        """Returns whether a condition is true on any rank."""
        return any(is_true for (is_true,) in self.exchange([condition]))

    def sum(self, values: torch.Tensor) -> torch.Tensor:
        """Returns the sum of the ranks' tensors, exchanged on their device, float64 on the host."""
        values = values.double()
        return (values if self.n == 1 else all_gather(values).sum(0)).cpu()

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Averages numbers over the ranks, by name, without NaN or those that are all NaN."""
        rows, means = [values] if self.n == 1 else process_group.gather_objects(values), {}
        for name in values:
            column = [row[name] for row in rows if not math.isnan(row.get(name, math.nan))]
            if column:
                means[name] = math.fsum(column) / len(column)
        return means

    def gather_if_any(self, value: T, is_needed: bool) -> list[T]:
        """Returns the picklable values of all ranks if any needs them, otherwise this rank's."""
        is_needed = self.any(is_needed)
        return process_group.gather_objects(value) if is_needed and self.n > 1 else [value]

    def check_drift(self, policy: torch.nn.Module, extra: Sequence[torch.Tensor] = ()) -> None:
        """Raises UserError on all ranks, naming the first parameter or buffer of a policy, or of
        what else a learner trains, whose bits differ. Synchronises.
        """
        if self.n == 1:
            return
        tensors = {**dict(policy.named_parameters()), **dict(policy.named_buffers())}
        tensors |= {f"extra.{i}": tensor for i, tensor in enumerate(extra)}
        rows = all_gather(checksums(tensors.values())).T.tolist()
        for name, sums in zip(tensors, rows, strict=True):
            if different := [f"rank {n}" for n, one in enumerate(sums) if one != sums[0]]:
                raise UserError(
                    f"The ranks drift apart: policy.{name} differs on {', '.join(different)}; "
                    "start all with the same options and packages; a learner of your own averages "
                    "gradients with megastep.agents.distributed.pooling.average_gradients. Earlier "
                    "checkpoints are intact"
                )


#: A process that trains a policy of its own.
ONE = Ranks()


def world() -> Ranks:
    """Returns all ranks that torchrun or `ranks=` started."""
    return Ranks(process_group.rank(), process_group.n_ranks())


def checksums(tensors: Iterable[torch.Tensor]) -> torch.Tensor:
    """Returns the sum of the bits of each of n tensors as integers, mod 2^64: (n,) int64."""
    with torch.no_grad():
        bits = [tensor.detach().view(INTEGERS[tensor.element_size()]) for tensor in tensors]
        return torch.stack([part.sum(dtype=torch.int64) for part in bits])
