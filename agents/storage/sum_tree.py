"""A sum tree on the device: samples indices in proportion to priorities (Schaul et al. 2016).

N priorities, M indices, F children per node. Level 0 holds the priorities in blocks of F. The sums
of its blocks are the entries of level 1, and so on, up to a level with a single block. Sums are
float64, since float32 would lose the smallest of a million priorities. A parent is always summed
from its children, never updated by differences, so rounding errors do not accumulate.
"""

import itertools

import torch

from megastep.agents.storage import replay_kernels as kernels
from megastep.agents.storage.copies import require_stored


class SumTree:
    """Holds N priorities, initially 0. Nothing synchronises and shapes are fixed, so CUDA graphs
    can record all methods.

    Args:
        n: N, number of priorities.
        device: device of the tree.
        fan_out: F, children per node. A GPU reads a block of 32 as fast as one number, and a
            million priorities then take only four levels.

    Raises:
        ValueError: if n < 1 or fan_out < 2.
    """

    def __init__(self, n: int, device: torch.device | str | None = None, fan_out: int = 32):
        if n < 1 or fan_out < 2:
            raise ValueError(
                f"a sum tree needs n >= 1 priorities and fan_out >= 2, not {n} and {fan_out}"
            )
        self.n, self.fan_out = n, fan_out
        self.levels = []  # (blocks, F) each
        while not self.levels or n > 1:
            n = -(-n // fan_out)
            self.levels.append(torch.zeros(n, fan_out, dtype=torch.float64, device=device))

    @property
    def priorities(self) -> torch.Tensor:
        """(N,) float64, a view. Only `set` may change priorities."""
        return self.levels[0].view(-1)[: self.n]

    @property
    def total(self) -> torch.Tensor:
        """(), the sum of all priorities."""
        return self.levels[-1].sum()

    @property
    def is_fused(self) -> bool:
        """Whether kernels implement `draw` and `set`."""
        top = self.levels[-1]
        is_known = self.fan_out == kernels.FAN_OUT and len(self.levels) <= kernels.MAX_LEVELS
        return top.is_cuda and is_known

    @property
    def bytes(self) -> int:
        """Size in bytes."""
        return sum(level.nbytes for level in self.levels)

    def set(self, index: torch.Tensor, values: torch.Tensor) -> None:
        """Sets priorities.

        Args:
            index: (M,) int64. If an index occurs several times, its largest value is stored.
            values: (M,), finite and at least 0.

        Raises:
            ValueError: if index and values do not both have shape (M,), or lack storage.
        """
        if index.ndim != 1 or index.shape != values.shape:
            raise ValueError(
                f"index and values must have one shape (M,), but index is {tuple(index.shape)} and "
                f"values is {tuple(values.shape)}"
            )
        require_stored(index=index, values=values)
        values = values.to(torch.float64)
        if self.is_fused and len(index) <= kernels.MAX_SET:
            if len(index):
                kernels.set_tree(self.levels, index.contiguous(), values.contiguous())
            return
        self.priorities.scatter_reduce_(0, index, values, "amax", include_self=False)
        for lower, upper in itertools.pairwise(self.levels):
            sums = upper.view(-1)
            if len(index) < len(lower):
                index = index // self.fan_out
                sums.index_copy_(0, index, lower.index_select(0, index).sum(-1))
            else:
                sums[: len(lower)] = lower.sum(-1)

    def draw(
        self, n: int, generator: torch.Generator | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns indices as from `sample` and their `probability`; on a GPU, in one kernel."""
        if self.is_fused:
            return kernels.draw(self.levels, self._fractions(n, generator))
        index = self.sample(n, generator)
        return index, self.probability(index)

    def sample(self, n: int, generator: torch.Generator | None = None) -> torch.Tensor:
        """Draws n indices in proportion to their priorities, (n,) int64 in ascending order.

        Sampling is stratified: one index is drawn from each of n equal parts of the total. Indices
        of priority 0 are never drawn, unless all priorities are 0; then each result is index 0.
        """
        if self.is_fused:
            return self.draw(n, generator)[0]
        top, fraction = self.levels[-1], self._fractions(n, generator)
        rest = (fraction + torch.arange(n, device=top.device)) / n * self.total
        children = torch.arange(self.fan_out, device=top.device)
        index = torch.zeros(n, dtype=torch.int64, device=top.device)
        for level in reversed(self.levels):
            block = level.index_select(0, index)
            sums = block.cumsum(-1)
            positive = block > 0
            # The first child whose cumulative sum exceeds the rest; if none does, because of
            # rounding, the last child with a positive priority.
            first = torch.where(positive & (sums > rest[:, None]), children, self.fan_out).amin(-1)
            last = torch.where(positive, children, 0).amax(-1)
            child = torch.minimum(first, last)
            rest = rest - (sums - block).gather(-1, child[:, None])[:, 0]
            index = index * self.fan_out + child
        return index

    def probability(self, index: torch.Tensor) -> torch.Tensor:
        """Returns the probability (M,) float64 of each index; 0 while all priorities are 0."""
        require_stored(index=index)
        tiny = torch.finfo(torch.float64).tiny
        return self.priorities.index_select(0, index) / self.total.clamp(min=tiny)

    def _fractions(self, n, generator) -> torch.Tensor:
        """Returns the position of each sample within its part, (n,) float64 from 0 to 1."""
        if n < 1:
            raise ValueError(f"n must be at least 1 index to draw, but {n} was given")
        device = self.levels[-1].device
        return torch.rand(n, generator=generator, dtype=torch.float64, device=device)
