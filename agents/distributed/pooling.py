"""Sums, moments and gradients over all ranks, as parts of an update. Nothing synchronises.

R ranks.
"""

from collections.abc import Iterable, Sequence

import torch
from torch import distributed

from megastep.agents.distributed.process_group import communicating, n_ranks, rank
from megastep.agents.distributed.segments import between_graphs

#: Number of entries, their mean and their variance; () or, for several quantities, mean and
#: variance of one shape.
Moments = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def all_reduce(tensor: torch.Tensor) -> torch.Tensor:
    """Sums a tensor over the ranks, in place, and returns it."""

    def call():
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


def masked_moments(x: torch.Tensor, valid: torch.Tensor) -> Moments:
    """Returns the number of valid entries, and their mean and variance (...,), 0 if none is valid.

    Args:
        x: (..., *shape), quantities of each entry; may hold anything where invalid.
        valid: (*shape) bool.
    """
    axes, is_invalid = tuple(range(-valid.dim(), 0)), ~valid
    n_valid = valid.sum()
    n = n_valid.clamp(min=1)
    mean = x.masked_fill(is_invalid, 0.0).sum(axes, keepdim=True) / n
    variance = (x - mean).square().masked_fill(is_invalid, 0.0).sum(axes) / n
    return n_valid, mean.view_as(variance), variance


def pool_moments(*moments: Moments) -> list[Moments]:
    """Returns the moments of the entries of all ranks together (Chan et al. 1979).

    One operation for all that are given.
    """
    if n_ranks() == 1:
        return list(moments)
    columns = [column.double().flatten() for each in moments for column in each]
    rows = all_gather(torch.cat(columns))
    pooled = []
    split = iter(rows.split([len(column) for column in columns], 1))
    for each, counts, means, variances in zip(moments, split, split, split, strict=True):
        n = counts.sum(0)
        divisor = n.clamp(min=1)
        mean = (counts * means).sum(0) / divisor
        variance = (counts * (variances + (means - mean).square())).sum(0) / divisor
        pooled.append(
            tuple(new.view_as(old).to(old.dtype) for new, old in zip((n, mean, variance), each))
        )
    return pooled


def average_gradients(
    parameters: Iterable[torch.nn.Parameter],
    n_valid: torch.Tensor,
    means: Sequence[torch.Tensor] = (),
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Averages gradients over the ranks, in place, each weighted by the number of entries that its
    loss is the mean over. A learner calls this after `backward()`, before it clips gradients.

    All ranks must call it equally often, with the same parameters. In one process nothing changes.

    Args:
        parameters: those without a gradient are left out.
        n_valid: (), the number of entries.
        means: tensors () to average in the same way, such as metrics.

    Returns:
        The number of entries of all ranks, and the means over them.
    """
    means = [value.detach() for value in means]
    if n_ranks() == 1:
        return n_valid, means
    with torch.no_grad():
        held = [p for p in parameters if p.grad is not None]
        ours = torch.cat([*(p.grad.flatten() for p in held), *(m.float()[None] for m in means)])
        n = n_valid.to(ours)
        bucket = all_reduce(torch.cat([ours * n, n[None]]))
        n = bucket[-1]
        averages = bucket[:-1] / n.clamp(min=1)
        sizes = [p.numel() for p in held]
        *gradients, means = averages.split([*sizes, len(means)])
        for p, gradient in zip(held, gradients, strict=True):
            p.grad = gradient.view_as(p)
    return n, list(means.unbind())
