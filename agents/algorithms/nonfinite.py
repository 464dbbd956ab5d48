"""Detection of NaN, infinity and overflow on the device, and their description on the host.

T time, B lanes.
"""

import dataclasses
from typing import Any

import torch
from torch.utils._pytree import tree_leaves_with_path

#: The largest magnitude allowed in a rollout. Squares of returns made of such rewards, summed over
#: millions of steps, still fit into float32 (3e38). A float16 that overflowed is inf, so larger.
LIMIT = 1e12


class NonFiniteError(RuntimeError):
    """Training cannot continue because of non-finite numbers. The message names the first one and
    the likely cure.
    """


@dataclasses.dataclass(frozen=True)
class NonFiniteValue:
    """A number that is NaN, infinite or beyond `LIMIT`.

    Attributes:
        name: name of the tensor, such as `obs.rgb` or `reward`.
        lane: lane of the rollout.
        step: step of that lane since the environment was reset, from 1.
        size: magnitude of the number.
    """

    name: str
    lane: int
    step: int
    size: float

    @property
    def is_from_env(self) -> bool:
        """True if the environment produced the number, false if the policy did."""
        return self.name.split(".")[0] in ("obs", "privileged", "reward")

    def __str__(self):
        return f"{self.name} of lane {self.lane} was {self.size:.3g} at step {self.step:,}"


class NonFiniteCheck:
    """Checks one rollout after another for non-finite numbers, and counts skipped updates.

    Only `read` synchronises. Everything is in place, so checks can be part of a CUDA graph.

    Args:
        device: device of the rollouts.
    """

    def __init__(self, device: torch.device):
        # [rollouts checked, then of the first non-finite number: its rollout (from 1; 0: none),
        #  its index among all numbers, its magnitude, and the updates skipped in a row]
        self.record = torch.zeros(5, dtype=torch.float64, device=device)

    def __call__(self, floats: dict[str, torch.Tensor]) -> torch.Tensor:
        """Checks a rollout and keeps its first non-finite number until `read`.

        Args:
            floats: tensors by name, each (T, B, ...) or (T+1, B, ...).

        Returns:
            () bool on the device, whether all numbers are finite and within `LIMIT`.
        """
        count, first = self.record[:1], self.record[1:4]
        count += 1
        sizes = torch.cat([_sizes(values) for values in floats.values()])
        is_finite, index = (sizes <= LIMIT).byte().min(0, keepdim=True)
        is_finite = is_finite.bool()
        latest = torch.cat([count, index, sizes.gather(0, index)])
        first.copy_(torch.where(is_finite | (first[:1] > 0), first, latest))
        return is_finite[0]

    def count(self, is_skipped: torch.Tensor) -> None:
        """Counts one update, () bool whether it was skipped."""
        self.record[4].add_(1).mul_(is_skipped)

    def read(self, floats: dict[str, torch.Tensor]) -> tuple[NonFiniteValue | None, int]:
        """Returns the first non-finite number since the last call, and the number of updates
        skipped in a row. Synchronises.

        Args:
            floats: tensors of any rollout; only names and shapes are used.
        """
        count, index, size, n_skipped = self.record[1:].tolist()
        self.record[1:4].zero_()
        value = _value_at(floats, int(count), int(index), size) if count else None
        return value, int(n_skipped)


def _sizes(values):
    """Returns the largest magnitude per time and lane, (T B,), NaN where there is a NaN."""
    if values.dim() > 2:
        values = values.flatten(2)
        if torch.finfo(values.dtype).max < LIMIT:
            # any number beyond LIMIT is inf in this dtype, and stays inf or becomes NaN in a sum,
            # which is five times faster than a maximum
            values = values.sum(-1, dtype=torch.float32)
        else:
            values = torch.maximum(values.amax(-1), -values.amin(-1))
    return values.abs().flatten().float()


def _value_at(floats, count, index, size):
    n_steps = min(len(values) for values in floats.values())
    for name, values in floats.items():
        n_lanes = values.shape[1]
        if index < len(values) * n_lanes:
            row, lane = divmod(index, n_lanes)
            return NonFiniteValue(name, lane, (count - 1) * n_steps + row + 1, size)
        index -= len(values) * n_lanes
    raise AssertionError("the index is beyond all numbers")


def nonfinite_leaf(tree: Any) -> str | None:
    """Returns the dotted path of the first non-finite tensor or float in nested dicts and lists, or
    None.
    """
    for path, leaf in tree_leaves_with_path(tree):
        if isinstance(leaf, (torch.Tensor, float)) and not torch.as_tensor(leaf).isfinite().all():
            return ".".join(str(getattr(part, "key", getattr(part, "idx", part))) for part in path)
    return None
