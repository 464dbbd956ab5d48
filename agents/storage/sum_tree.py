"""A sum tree of priorities: sampling in proportion to them, on the device (Schaul et al. 2016).

Axes: N priorities, M indices, F children per node. Level 0 holds the priorities, in blocks of F
whose sums are the entries of level 1, and so on up to a level of one block. Sums are float64: with
float32 the least of a million priorities would be lost in them. A parent is computed from its
children, never from differences, so that no error accumulates.
"""

import itertools

import torch


class SumTree:
    """N priorities, all 0 at first. Nothing synchronises, and shapes are fixed by the arguments'
    shapes, so all of it can be part of a CUDA graph.

    The fan-out F is wide, for a GPU reads a block of 32 as fast as one number: a million priorities
    are four levels.
    """

    def __init__(self, n: int, device: torch.device | str | None = None, fan_out: int = 32):
        if n < 1 or fan_out < 2:
            raise ValueError(
                f"a sum tree needs a priority and two children per node, not {n} and {fan_out}"
            )
        self.n, self.fan_out = n, fan_out
        self.levels = []  # (blocks, F) each
        while not self.levels or n > 1:
            n = -(-n // fan_out)
            self.levels.append(torch.zeros(n, fan_out, dtype=torch.float64, device=device))

    @property
    def priorities(self) -> torch.Tensor:
        """(N,) float64, a view: change them by `set` alone."""
        return self.levels[0].view(-1)[: self.n]

    @property
    def total(self) -> torch.Tensor:
        """The sum of all, ()."""
        return self.levels[-1].sum()

    @property
    def bytes(self) -> int:
        return sum(level.nbytes for level in self.levels)

    def set(self, index: torch.Tensor, values: torch.Tensor) -> None:
        """Gives priorities at index (M,) int64 their values (M,), finite and at least 0. Where an
        index occurs several times, the largest of its values stands.
        """
        values = values.to(torch.float64)
        self.priorities.scatter_reduce_(0, index, values, "amax", include_self=False)
        for lower, upper in itertools.pairwise(self.levels):
            sums = upper.view(-1)
            if len(index) < len(lower):
                index = index // self.fan_out
                sums.index_copy_(0, index, lower.index_select(0, index).sum(-1))
            else:
                sums[: len(lower)] = lower.sum(-1)

    def sample(self, n: int, generator: torch.Generator | None = None) -> torch.Tensor:
        """(n,) int64: indices drawn in proportion to their priorities, one in each of n equal parts
        of the total, in order. No priority of 0 is drawn, unless all are: then index 0 is.
        """
        top = self.levels[-1]
        share = torch.rand(n, generator=generator, dtype=torch.float64, device=top.device)
        left = (share + torch.arange(n, device=top.device)) / n * self.total
        children = torch.arange(self.fan_out, device=top.device)
        index = torch.zeros(n, dtype=torch.int64, device=top.device)
        for level in reversed(self.levels):
            block = level.index_select(0, index)
            sums = block.cumsum(-1)
            positive = block > 0
            # The first child whose sum is beyond what is left. Rounding may leave more than there
            # is: then the last child that can be drawn.
            first = torch.where(positive & (sums > left[:, None]), children, self.fan_out).amin(-1)
            last = torch.where(positive, children, 0).amax(-1)
            child = torch.minimum(first, last)
            left = left - (sums - block).gather(-1, child[:, None])[:, 0]
            index = index * self.fan_out + child
        return index

    def probability(self, index: torch.Tensor) -> torch.Tensor:
        """(M,) float64: how likely each index (M,) is drawn; 0 while all priorities are 0."""
        tiny = torch.finfo(torch.float64).tiny
        return self.priorities.index_select(0, index) / self.total.clamp(min=tiny)
