"""Sums, moments and gradients over all ranks, as parts of an update. Nothing synchronises.

R ranks.
"""

from collections.abc import Iterable, Sequence
from typing import cast

import torch
from torch import distributed

from megastep.agents.distributed.process_group import communicating, n_ranks, rank
from megastep.agents.distributed.segments import between_graphs
from megastep.agents.private_ops import copy_all_
from megastep.agents.types import Moments


def all_reduce(tensor: torch.Tensor) -> torch.Tensor:
    """Sums a tensor over the ranks, in place, and returns it."""

    def call() -> None:
        with communicating():
            distributed.all_reduce(tensor)

    if n_ranks() > 1:
        between_graphs(call)
    return tensor


def all_gather(tensor: torch.Tensor) -> torch.Tensor:
    """Returns the tensors of all ranks, (R, ...)."""
    if n_ranks() == 1:
        return tensor[None]
    gathered = tensor.new_zeros(n_ranks(), *tensor.shape)
    gathered[rank()] = tensor
    return all_reduce(gathered)  # each number is added to zeros, so it keeps its bits


def on_all_ranks(condition: torch.Tensor) -> torch.Tensor:
    """Returns () bool, whether a () bool is true on every rank."""
    if n_ranks() == 1:
        return condition
    return all_reduce((~condition).int()) == 0


def pool_moments(*moments: Moments) -> list[Moments]:
    """Returns the moments of the entries of all ranks together (Chan et al. 1979).

    One operation for all that are given, and as many kernels as for one.
    """
    if n_ranks() == 1 or not moments:
        return list(moments)
    own_counts, own_means, own_variances = zip(*moments)
    sizes = [mean.numel() for mean in own_means]
    statistics = torch.cat([column.flatten() for column in (*own_means, *own_variances)])
    rows = all_gather(torch.cat([torch.stack(own_counts).double(), statistics.double()]))
    counts, means, variances = rows.split([len(sizes), sum(sizes), sum(sizes)], 1)
    n = _in_common_dtype(counts.sum(0), own_counts)
    # repeat each count for every number of its moments
    columns = counts.split(1, 1)
    counts = torch.cat([column.expand(-1, size) for column, size in zip(columns, sizes)], 1)
    divisor = counts.sum(0).clamp(min=1)
    mean = (counts * means).sum(0) / divisor
    variance = (counts * (variances + (means - mean).square())).sum(0) / divisor
    mean, variance = _in_common_dtype(torch.stack([mean, variance]), own_means)
    pooled = zip(n, mean.split(sizes), variance.split(sizes), strict=True)
    moments_of_all = [
        tuple(new.view_as(old).to(old.dtype) for new, old in zip(each, before, strict=True))
        for each, before in zip(pooled, moments, strict=True)
    ]
    return cast("list[Moments]", moments_of_all)


def _in_common_dtype(x, others) -> torch.Tensor:
    """Returns x in the dtype of the others if all have one: a kernel instead of one for each."""
    dtypes = {other.dtype for other in others}
    return x.to(*dtypes) if len(dtypes) == 1 else x


def pool_with_condition(
    condition: torch.Tensor, *moments: Moments
) -> tuple[torch.Tensor, list[Moments]]:
    """Returns `on_all_ranks(condition)` and `pool_moments(*moments)`, by one operation."""
    if n_ranks() == 1:
        return condition, list(moments)
    one = torch.ones_like(condition, dtype=torch.int64)
    is_false = (~condition).float()
    (_, fraction_false, _), *pooled = pool_moments((one, is_false, is_false), *moments)
    return fraction_false == 0, pooled


def average_gradients(
    parameters: Iterable[torch.nn.Parameter],
    n_valid: torch.Tensor,
    means: Sequence[torch.Tensor] = (),
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Averages gradients over the ranks, in place, each weighted by the number of entries that its
    loss is the mean over. A learner calls this after `backward()`, before it clips gradients.

    All ranks must call it equally often, with the same parameters. In one process nothing changes.

    Args:
        parameters: those without a gradient are left out. Gradients are float32.
        n_valid: (), the number of entries.
        means: tensors () to average in the same way, such as metrics.

    Returns:
        The number of entries of all ranks, and the means over them.
    """
    means = [value.detach() for value in means]
    if n_ranks() == 1:
        return n_valid, means
    with torch.no_grad():
        held = [(p, p.grad) for p in parameters if p.grad is not None]
        gradients = [gradient.flatten() for _, gradient in held]
        numbers = [number.float() for number in means] + [torch.ones_like(n_valid).float()]
        # one buffer, in which each gradient begins at a multiple of 16 bytes, as Adam likes it
        sizes = [n + -n % 4 for n in map(len, gradients)]
        n_numbers = sum(sizes) + len(numbers)
        bucket = torch.zeros(n_numbers, dtype=torch.float32, device=n_valid.device)
        *parts, pooled = bucket.split([*sizes, len(numbers)])
        parts = [part[: len(gradient)] for part, gradient in zip(parts, gradients)]
        copy_all_([*parts, *pooled.unbind()], [*gradients, *numbers])
        all_reduce(bucket.mul_(n_valid))
        n = pooled[-1].clone()
        bucket /= n.clamp(min=1)
        for (p, _), part in zip(held, parts, strict=True):
            p.grad = part.view_as(p)
    return n, list(pooled[:-1].unbind())
