"""Sums, moments and gradients pooled over the ranks that train one policy. Never synchronises, so
updates can use it.

R ranks.
"""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from typing import cast

import torch
from torch import distributed

from megastep.agents.distributed.process_group import communicating, n_ranks, rank
from megastep.agents.types import Moments

_is_alone = False


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Pools nothing inside: each rank trains policies of its own, members of a population."""
    global _is_alone
    before, _is_alone = _is_alone, True
    try:
        yield
    finally:
        _is_alone = before


def n_pooled() -> int:
    """Returns R, the ranks that train one policy: 1 in a single process, and `alone`."""
    return 1 if _is_alone else n_ranks()


def all_reduce(tensor: torch.Tensor) -> torch.Tensor:
    """Sums a tensor over the ranks, in place, and returns it."""

    if n_pooled() > 1:
        with communicating():
            distributed.all_reduce(tensor)
    return tensor


def all_gather(tensor: torch.Tensor) -> torch.Tensor:
    """Returns the tensors of all ranks, (R, ...)."""
    if n_pooled() == 1:
        return tensor[None]
    gathered = tensor.new_zeros(n_ranks(), *tensor.shape)
    gathered[rank()] = tensor
    return all_reduce(gathered)  # adding zeros keeps every bit


def pool_moments(*moments: Moments) -> list[Moments]:
    """Pools the moments (count, mean, variance) of all ranks (Chan et al. 1979), in one collective
    operation. Shapes may differ among moments, but not among ranks.
    """
    if n_pooled() == 1 or not moments:
        return list(moments)
    own_counts, own_means, own_variances = zip(*moments)
    sizes = [mean.numel() for mean in own_means]
    statistics = torch.cat([column.flatten() for column in (*own_means, *own_variances)])
    numbers = torch.stack(own_counts)
    rows = all_gather(torch.cat([numbers.double(), statistics.double()]))
    counts, means, variances = rows.split([len(sizes), sum(sizes), sum(sizes)], 1)
    n = counts.sum(0).to(numbers.dtype)
    # one count per entry of a mean
    columns = counts.split(1, 1)
    counts = torch.cat([column.expand(-1, size) for column, size in zip(columns, sizes)], 1)
    divisor = counts.sum(0).clamp(min=1)
    mean = (counts * means).sum(0) / divisor
    variance = (counts * (variances + (means - mean).square())).sum(0) / divisor
    mean, variance = mean.to(statistics.dtype), variance.to(statistics.dtype)
    pooled = zip(n, mean.split(sizes), variance.split(sizes), strict=True)
    moments_of_all = [
        tuple(new.view_as(old).to(old.dtype) for new, old in zip(each, before, strict=True))
        for each, before in zip(pooled, moments, strict=True)
    ]
    return cast("list[Moments]", moments_of_all)


def pool_with_condition(
    condition: torch.Tensor, *moments: Moments
) -> tuple[torch.Tensor, list[Moments]]:
    """Returns whether a condition, () bool, is true on every rank, and the pooled moments."""
    if n_pooled() == 1:
        return condition, list(moments)
    unused = condition.float()
    (n_true, *_), *pooled = pool_moments((condition.long(), unused, unused), *moments)
    return n_true == n_ranks(), pooled


def average_gradients(
    parameters: Iterable[torch.nn.Parameter],
    n_valid: torch.Tensor,
    means: Sequence[torch.Tensor] = (),
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Averages gradients over the ranks, in place, weighted by the number of valid entries of each
    rank's loss. A learner calls this after `backward()` and before it clips gradients.

    All ranks must make the same calls, with the same parameters. A no-op in a single process.

    Args:
        parameters: parameters with float32 gradients; those without a gradient are skipped.
        n_valid: (), number of entries that this rank's loss averages over.
        means: tensors () to average with the same weights, such as metrics.

    Returns:
        The sum of n_valid over the ranks, and the averaged means.
    """
    means = [value.detach() for value in means]
    if n_pooled() == 1:
        return n_valid, means
    with torch.no_grad():
        held = [(p, p.grad) for p in parameters if p.grad is not None]
        numbers = torch.stack([number.float() for number in [*means, n_valid]])
        bucket = torch.cat([*(gradient.flatten() for _, gradient in held), numbers])
        bucket[:-1] *= n_valid
        n = all_reduce(bucket)[-1]
        bucket[:-1] /= n.clamp(min=1)
        *parts, pooled = bucket.split([*(p.numel() for p, _ in held), len(numbers)])
        for (p, _), part in zip(held, parts, strict=True):
            p.grad = part.view_as(p)
    return n, list(pooled[:-1].unbind())
