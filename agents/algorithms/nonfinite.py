"""Detects NaN, infinity and overflow on the device, and describes them on the host.

T time, B lanes.
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch.utils._pytree import tree_leaves_with_path

from megastep.agents.algorithms.kernels import LIBRARY
from megastep.agents.networks.fused import fused
from megastep.kernels.build.launch import Blocks, launch
from megastep.types import Tree

#: Largest magnitude allowed in a rollout. With such rewards, squared returns summed over millions
#: of steps still fit into float32 (3e38). float16 overflows to inf, which is above the limit, too.
LIMIT = 1e12
_MAX_TENSORS, _THREADS, _WORDS = (
    LIBRARY.constants[f"CHECKED_{name}"] for name in ("TENSORS", "THREADS", "WORDS")
)


class NonFiniteError(RuntimeError):
    """Training cannot continue because of a NaN or an infinity. The message names the first one and
    the likely cure. The policy is intact if it `is_from_env`.
    """

    def __init__(self, message: str, is_from_env: bool = False):
        super().__init__(message)
        self.is_from_env = is_from_env


@dataclasses.dataclass(frozen=True)
class NonFiniteValue:
    """The first number of a rollout that is NaN, infinite or beyond `LIMIT`.

    Attributes:
        name: name of the tensor, such as `obs.rgb` or `reward`.
        lane: lane of the rollout.
        step: environment step since `reset`, from 1: the one that returned the number or, if the
            policy produced it, the one that it chose an action for. 0 if `reset` returned it.
        size: magnitude of the number.
        n_lanes: number of lanes of the rollout with such numbers.
        n_agents: lanes per environment.
    """

    name: str
    lane: int
    step: int
    size: float
    n_lanes: int = 1
    n_agents: int = 1

    @property
    def is_from_env(self) -> bool:
        """True if the environment produced the number, False if the policy did."""
        return self.name.split(".")[0] in ("obs", "privileged", "reward")

    def in_env(self, lanes: Sequence[int], n_agents: int) -> "NonFiniteValue":
        """Returns a copy with the environment's lane for the lane of the rollout."""
        return dataclasses.replace(self, lane=int(lanes[self.lane]), n_agents=n_agents)

    def __str__(self) -> str:
        env = f" (environment {self.lane // self.n_agents})" if self.n_agents > 1 else ""
        text = f"{self.name} of lane {self.lane}{env} was {self.size:.3g} at step {self.step:,}"
        if (n_others := self.n_lanes - 1) > 0:
            text += f"; and so for {n_others:,} more lane{'s' * (n_others > 1)}"
        return text


def _check_on_gpu(check, floats) -> torch.Tensor:
    """Finds the first row of each lane with a bad number, then records the first lane."""
    tensors = list(floats.values())
    n_steps, n_lanes = min(map(len, tensors)) + 1, tensors[0].shape[1]
    device = tensors[0].device
    first_rows = torch.full((n_lanes,), 2**31 - 1, dtype=torch.int32, device=device)
    is_finite = torch.empty((), dtype=torch.bool, device=device)
    packed, n_blocks = [], 0
    for tensor in tensors:
        packed.append(
            LIBRARY.params.CheckedTensorParams(
                **dict(values=tensor, first_block=n_blocks, n_steps=len(tensor)),
                n_features=math.prod(tensor.shape[2:]),
                is_half=int(tensor.dtype == torch.float16),
            )
        )
        # one more block than full ones, for the numbers after the last whole word
        n_blocks += tensor.numel() * tensor.element_size() // (16 * _THREADS * _WORDS) + 1
    fields = dict(tensors=b"".join(packed), first_rows=first_rows, n_tensors=len(tensors))
    fields |= dict(n_steps=n_steps, n_lanes=n_lanes)
    blocks = Blocks(n_blocks, threads=_THREADS)
    launch(LIBRARY, "find_bad", device, blocks, **fields, limit=LIMIT)
    fields |= dict(record=check.record, is_finite=is_finite)
    blocks = Blocks(1, threads=LIBRARY.constants["RECORD_THREADS"])
    launch(LIBRARY, "record", device, blocks, **fields)
    return is_finite


def _are_readable(floats) -> bool:
    tensors = list(floats.values())
    return len(tensors) <= _MAX_TENSORS and all(
        tensor.is_cuda
        and tensor.dtype in (torch.float16, torch.float32)
        and tensor.is_contiguous()
        and tensor.data_ptr() % 16 == 0
        and len(tensor) - min(map(len, tensors)) <= 1
        for tensor in tensors
    )


class NonFiniteCheck:
    """Checks rollouts for non-finite numbers and counts skipped updates.

    Only `read` synchronises. All else works in place on fixed shapes, so CUDA graphs can record it.
    """

    def __init__(self, device: torch.device):
        # [0] rollouts checked
        # [1] updates skipped in a row
        # The rest describes the first rollout with non-finite numbers:
        # [2] its number, from 1; 0 if there is none
        # [3] how many of its lanes have a non-finite number
        # [4] the index in `sizes` of the first such number
        # [5] its magnitude: -1 for NaN, 1.8e308 for infinity
        self.record = torch.zeros(6, dtype=torch.float64, device=device)

    @fused(_check_on_gpu, lambda self, floats: _are_readable(floats))
    def __call__(self, floats: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns whether all numbers of a rollout are finite and within `LIMIT`, () bool. Keeps
        the first other one until `read`.

        Args:
            floats: tensors by name, each (T, B, ...) or (T+1, B, ...), at least one of T.
        """
        count, first = self.record[:1], self.record[2:]
        count += 1
        # The largest magnitudes, ((T+1) F, B) for F tensors, NaN where there is a NaN. Rows are
        # ordered by time, then by tensor. Row t of a tensor with T rows belongs to world t+1.
        tensors = list(floats.values())
        n_steps, n_lanes = min(map(len, tensors)), tensors[0].shape[1]
        shape = n_steps + 1, len(tensors), n_lanes
        sizes = tensors[0].new_zeros(shape, dtype=torch.float32)
        for i, values in enumerate(tensors):
            numbers = values
            if values.dim() > 2:
                numbers = values.flatten(2)
                if torch.finfo(values.dtype).max < LIMIT:
                    # float16 cannot hold numbers beyond LIMIT but inf, which a sum turns into inf
                    # or NaN; sums are five times as fast as maxima
                    numbers = numbers.sum(-1, dtype=torch.float32)
                else:
                    numbers = torch.maximum(numbers.amax(-1), -numbers.amin(-1))
            sizes[-len(values) :, i] = numbers.abs()
        sizes = sizes.flatten(0, 1)
        is_bad = ~(sizes <= LIMIT)
        n_bad = is_bad.any(0).sum(dtype=torch.float64)
        index = is_bad.flatten().byte().argmax()
        size = sizes.flatten()[index].double().nan_to_num(nan=-1.0)
        latest = torch.stack([count[0], n_bad, index.double(), size])
        first.copy_(torch.where((n_bad == 0) | (self.record[2] > 0), first, latest))
        return n_bad == 0

    def state_dict(self) -> torch.Tensor:
        """Returns (2,) float64: rollouts checked, and updates skipped in a row."""
        return self.record[:2].clone()  # when the rest is read depends on wall-clock time

    def load_state_dict(self, counts: torch.Tensor) -> None:
        """Restores a `state_dict`."""
        self.record.zero_()[:2] = counts.to(self.record)

    def count(self, is_skipped: torch.Tensor) -> None:
        """Counts the updates skipped in a row. `is_skipped`, () bool: whether this one was."""
        self.record[1].add_(1).mul_(is_skipped)

    def read(self, floats: dict[str, torch.Tensor]) -> tuple[NonFiniteValue | None, int]:
        """Returns and clears the first non-finite number since the last call, or None; and the
        number of updates skipped in a row. Synchronises. Only names and shapes of `floats` are
        used, those of any rollout.
        """
        _, n_skipped, rollout, n_bad, index, size = self.record.tolist()
        self.record[2:].zero_()
        if not rollout:
            return None, int(n_skipped)
        n_steps, n_lanes = min(map(len, floats.values())), next(iter(floats.values())).shape[1]
        row, lane = divmod(int(index), n_lanes)
        row, i = divmod(row, len(floats))
        size = math.nan if size < 0 else math.inf if size > torch.finfo(torch.float32).max else size
        step = (int(rollout) - 1) * n_steps + row
        value = NonFiniteValue(list(floats)[i], lane, step, size, int(n_bad))
        return value, int(n_skipped)


def nonfinite_leaf(tree: Tree) -> str | None:
    """Returns the dotted path of the first non-finite tensor in nested dicts and lists, or None."""
    for path, leaf in tree_leaves_with_path(tree):
        if isinstance(leaf, torch.Tensor) and not leaf.isfinite().all():
            return ".".join(str(getattr(part, "key", getattr(part, "idx", part))) for part in path)
    return None
