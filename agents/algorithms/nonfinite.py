"""Numbers that cannot be learnt from: found on the device, named on the host.

Axes: T time, B lanes, `...` any more.
"""

import dataclasses
from typing import Any

import torch
from torch.utils._pytree import tree_leaves_with_path

#: No number of a rollout may be larger: the squares of returns made of such rewards, summed over
#: millions of steps, still fit into float32 (3e38). A float16 that overflowed is inf, and larger.
LIMIT = 1e12


class NonFiniteError(RuntimeError):
    """Training cannot go on, for its numbers are not finite. The message says which came first,
    and the likely cure.
    """


@dataclasses.dataclass(frozen=True)
class NonFiniteValue:
    """A number beyond `LIMIT`, or not finite: the tensor's name, the lane, which of its steps since
    the environment was reset (the first is 1), and the size.
    """

    name: str
    lane: int
    step: int
    size: float

    @property
    def is_from_env(self) -> bool:
        """Whether the environment gave it, rather than the policy."""
        return self.name.split(".")[0] in ("obs", "privileged", "reward")

    def __str__(self):
        return f"{self.name} of lane {self.lane} was {self.size:.3g} at step {self.step:,}"


class NonFiniteCheck:
    """Looks over one rollout after another, and counts the updates that were skipped in a row.

    Nothing synchronises but `read`; all is in place, so it can be part of a CUDA graph.
    """

    def __init__(self, device: torch.device):
        # rollouts looked over; of the first bad number: which rollout, counted from 1 (0: none was
        # found), its place among all numbers, its size; updates skipped in a row
        self.record = torch.zeros(5, dtype=torch.float64, device=device)

    def __call__(self, numbers: dict[str, torch.Tensor]) -> torch.Tensor:
        """Whether all of a rollout's `numbers`, each (T, B, ...) or (T+1, B, ...), can be learnt
        from: a bool () on the device. The first that cannot is remembered until it is read.
        """
        count, first = self.record[:1], self.record[1:4]
        count += 1
        sizes = torch.cat([_sizes(values) for values in numbers.values()])
        is_fine, place = (sizes <= LIMIT).byte().min(0, keepdim=True)
        is_fine = is_fine.bool()
        found = torch.cat([count, place, sizes.gather(0, place)])
        first.copy_(torch.where(is_fine | (first[:1] > 0), first, found))
        return is_fine[0]

    def count(self, is_skipped: torch.Tensor) -> None:
        """Counts an update, given whether it was skipped, a bool ()."""
        self.record[4].add_(1).mul_(is_skipped)

    def read(self, numbers: dict[str, torch.Tensor]) -> tuple[NonFiniteValue | None, int]:
        """The first bad number since the last call, and how many updates were skipped in a row.
        `numbers` are those of any rollout, for their shapes. Synchronises.
        """
        count, place, size, skipped = self.record[1:].tolist()
        self.record[1:4].zero_()
        return _named(numbers, int(count), int(place), size) if count else None, int(skipped)


def _sizes(values):
    """The largest absolute value at each time of each lane, (T B,), nan where there is a nan."""
    if values.dim() > 2:
        values = values.flatten(2)
        if torch.finfo(values.dtype).max < LIMIT:
            # whatever is too large is inf already, and stays so in a sum: a fifth of the time
            values = values.sum(-1, dtype=torch.float32)
        else:
            values = torch.maximum(values.amax(-1), -values.amin(-1))
    return values.abs().flatten().float()


def _named(numbers, count, place, size):
    n_steps = min(len(values) for values in numbers.values())
    for name, values in numbers.items():
        n_lanes = values.shape[1]
        if place < len(values) * n_lanes:
            row, lane = divmod(place, n_lanes)
            return NonFiniteValue(name, lane, (count - 1) * n_steps + row + 1, size)
        place -= len(values) * n_lanes
    raise AssertionError("the place is beyond all numbers")


def nonfinite_leaf(tree: Any) -> str | None:
    """The path of the first tensor or number in nested dicts and lists that is not finite, if
    any.
    """
    for path, leaf in tree_leaves_with_path(tree):
        if isinstance(leaf, (torch.Tensor, float)) and not torch.as_tensor(leaf).isfinite().all():
            return ".".join(str(getattr(part, "key", getattr(part, "idx", part))) for part in path)
    return None
