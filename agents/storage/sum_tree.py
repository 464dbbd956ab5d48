"""A sum tree on the device: samples indices in proportion to priorities (Schaul et al. 2016).

N priorities, M indices, F children per node. Level 0 holds the priorities in blocks of F. The sums
of its blocks are the entries of level 1, and so on, up to a level with a single block. Sums are
float64, since float32 would lose the smallest of a million priorities. A parent is always summed
from its children, never updated by differences, so rounding errors do not accumulate.
"""

import itertools

import torch

from megastep.agents.networks.fused import fused
from megastep.agents.storage.copies import LIBRARY
from megastep.kernels.build.launch import WARP, Blocks, launch

#: Indices that a launch sets, and its threads.
MAX_SET, SET_THREADS = LIBRARY.constants["MAX_SET"], LIBRARY.constants["SET_THREADS"]


def packed(tree: "SumTree") -> bytes:
    """Returns a tree as kernels take it."""
    rows = [LIBRARY.params.TreeLevelParams(sums=level) for level in tree.levels]
    return LIBRARY.params.SumTreeParams(levels=b"".join(rows), n_levels=len(tree.levels))


def has_kernels(tree: "SumTree", n_set: int = 0) -> bool:
    """Returns whether kernels draw from a tree, and set so many priorities."""
    is_known = tree.fan_out == WARP and len(tree.levels) <= LIBRARY.constants["MAX_LEVELS"]
    return tree.levels[-1].is_cuda and is_known and n_set <= MAX_SET


def _draw_on_gpu(tree, fractions) -> tuple[torch.Tensor, torch.Tensor]:
    index = torch.empty_like(fractions, dtype=torch.int64)
    probability = torch.empty_like(fractions)
    launch(
        *(LIBRARY, "sample_tree", fractions.device, WARP * len(fractions)),
        **dict(tree=packed(tree), fractions=fractions, index=index, probability=probability),
        n_samples=len(fractions),
    )
    return index, probability


def _store_on_gpu(tree, index, values) -> None:
    if len(index):
        launch(
            *(LIBRARY, "set_tree", index.device, Blocks(1, threads=SET_THREADS)),
            **dict(tree=packed(tree), index=index.contiguous(), values=values.contiguous()),
            n=len(index),
        )


class SumTree:
    """Holds N priorities, initially 0. Nothing synchronises and shapes are fixed, so CUDA graphs
    can record all methods. A GPU reads a block of 32 children as fast as one number, and a million
    priorities then take only four levels.
    """

    def __init__(self, n: int, device: torch.device | str | None = None, fan_out: int = 32):
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

    def set(self, index: torch.Tensor, values: torch.Tensor) -> None:
        """Sets the priorities of an index (M,) int64 to values (M,), finite and at least 0. If an
        index occurs several times, its largest value is stored.
        """
        self._store(index, values.to(torch.float64))

    @fused(_store_on_gpu, lambda self, index, values: has_kernels(self, len(index)))
    def _store(self, index, values) -> None:
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
        """Draws n indices in proportion to their priorities, (n,) int64 in ascending order, and
        returns their `probability`, too.

        Sampling is stratified: one index is drawn from each of n equal parts of the total. Indices
        of priority 0 are never drawn, unless all priorities are 0; then each result is index 0.
        """
        device = self.levels[-1].device
        # the position of each sample within its part, from 0 to 1
        return self._at(torch.rand(n, generator=generator, dtype=torch.float64, device=device))

    @fused(_draw_on_gpu, lambda self, fractions: has_kernels(self))
    def _at(self, fractions) -> tuple[torch.Tensor, torch.Tensor]:
        n, top = len(fractions), self.levels[-1]
        rest = (fractions + torch.arange(n, device=top.device)) / n * self.total
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
        return index, self.probability(index)

    def probability(self, index: torch.Tensor) -> torch.Tensor:
        """Returns the probability (M,) float64 of each index; 0 while all priorities are 0."""
        tiny = torch.finfo(torch.float64).tiny
        return self.priorities.index_select(0, index) / self.total.clamp(min=tiny)
