"""A sum tree on the device: samples indices in proportion to priorities (Schaul et al. 2016).

N priorities, M indices. A node has 32 children. Level 0 holds the priorities in blocks of 32. The
sums of its blocks are the entries of level 1, and so on, up to a level with a single block. Sums
are float64, since float32 would lose the smallest of a million priorities. A parent is always
summed from its children, never updated by differences, so rounding errors do not accumulate.
"""

import itertools

import torch

from megastep.agents.networks.fused import fused
from megastep.agents.storage.copies import LIBRARY
from megastep.kernels.build.launch import WARP, Blocks, launch

#: Indices that a launch sets, and its threads.
MAX_SET, SET_THREADS = LIBRARY.constants["MAX_SET"], LIBRARY.constants["SET_THREADS"]
#: What a GPU reads as fast as one number; a million priorities take four levels.
FAN_OUT = WARP


def packed(tree: "SumTree") -> bytes:
    """Returns a tree as kernels take it."""
    rows = [LIBRARY.params.TreeLevelParams(sums=level) for level in tree.levels]
    return LIBRARY.params.SumTreeParams(levels=b"".join(rows), n_levels=len(tree.levels))


def has_kernels(tree: "SumTree", n_set: int = 0) -> bool:
    """Returns whether kernels draw from a tree, and set so many priorities."""
    return tree.levels[-1].is_cuda and n_set <= MAX_SET


def _draw_on_gpu(tree, fractions) -> tuple[torch.Tensor, torch.Tensor]:
    index = torch.empty_like(fractions, dtype=torch.int64)
    probability = torch.empty_like(fractions)
    launch(
        *(LIBRARY, "sample_tree", fractions.device, WARP * len(fractions)),
        **dict(tree=packed(tree), fractions=fractions, index=index, probability=probability),
        n_samples=len(fractions),
    )
    return index, probability


def _set_on_gpu(tree, index, values) -> None:
    values = values.to(torch.float64).contiguous()
    launch(
        *(LIBRARY, "set_tree", index.device, Blocks(min(len(index), 1), threads=SET_THREADS)),
        **dict(tree=packed(tree), index=index.contiguous(), values=values, n=len(index)),
    )


class SumTree:
    """Holds N priorities, initially 0. Nothing synchronises and shapes are fixed, so CUDA graphs
    can record all methods.
    """

    def __init__(self, n: int, device: torch.device | str | None = None):
        self.n = n
        self.levels = []  # (blocks, 32) each
        while not self.levels or n > 1:
            n = -(-n // FAN_OUT)
            self.levels.append(torch.zeros(n, FAN_OUT, dtype=torch.float64, device=device))

    @property
    def priorities(self) -> torch.Tensor:
        """(N,) float64, a view. Only `set` may change priorities."""
        return self.levels[0].view(-1)[: self.n]

    @property
    def total(self) -> torch.Tensor:
        """(), the sum of all priorities."""
        return self.levels[-1].sum()

    @fused(_set_on_gpu, lambda self, index, values: has_kernels(self, len(index)))
    def set(self, index: torch.Tensor, values: torch.Tensor) -> None:
        """Sets the priorities of an index (M,) int64 to values (M,), finite and at least 0. If an
        index occurs several times, its largest value is stored.
        """
        values = values.to(torch.float64)
        self.priorities.scatter_reduce_(0, index, values, "amax", include_self=False)
        for lower, upper in itertools.pairwise(self.levels):
            sums = upper.view(-1)
            if len(index) < len(lower):
                index = index // FAN_OUT
                sums.index_copy_(0, index, lower.index_select(0, index).sum(-1))
            else:
                sums[: len(lower)] = lower.sum(-1)

    def draw(
        self, n: int, generator: torch.Generator | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draws n indices in proportion to their priorities, (n,) int64 in ascending order, and
        returns their probability (n,), too, 0 while all priorities are 0.

        Sampling is stratified: one index is drawn from each of n equal parts of the total. Indices
        of priority 0 are never drawn, unless all priorities are 0; then each result is index 0.
        """
        device = self.levels[-1].device
        # the position of each sample within its part, from 0 to 1
        return self._at(torch.rand(n, generator=generator, dtype=torch.float64, device=device))

    @fused(_draw_on_gpu, lambda self, fractions: has_kernels(self))
    def _at(self, fractions) -> tuple[torch.Tensor, torch.Tensor]:
        n, total, device = len(fractions), self.total, fractions.device
        rest = (fractions + torch.arange(n, device=device)) / n * total
        children = torch.arange(FAN_OUT, device=device)
        index = torch.zeros(n, dtype=torch.int64, device=device)
        for level in reversed(self.levels):
            block = level.index_select(0, index)
            sums = block.cumsum(-1)
            positive = block > 0
            # The first child whose cumulative sum exceeds the rest; if none does, because of
            # rounding, the last child with a positive priority.
            first = torch.where(positive & (sums > rest[:, None]), children, FAN_OUT).amin(-1)
            last = torch.where(positive, children, 0).amax(-1)
            child = torch.minimum(first, last)
            rest = rest - (sums - block).gather(-1, child[:, None])[:, 0]
            index = index * FAN_OUT + child
        tiny = torch.finfo(torch.float64).tiny
        return index, self.priorities.index_select(0, index) / total.clamp(min=tiny)
