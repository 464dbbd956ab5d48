"""Statistics over valid entries. Invalid entries may hold anything, NaN included.

`valid` is a bool tensor of the shape of the numbers.
"""

import torch

from megastep.agents.distributed.pooling import pool_moments
from megastep.agents.networks.running_norm import masked_moments, normalise_masked


def masked_mean(x: torch.Tensor, valid: torch.Tensor, axis: int | None = None) -> torch.Tensor:
    """Returns the mean of the valid entries, overall or along an axis; 0 if none is valid."""
    return x.masked_fill(~valid, 0.0).sum(axis) / valid.sum(axis).clamp(min=1)


def pooled_mean(x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Returns the mean of the valid entries of all ranks."""
    mean = masked_mean(x, valid)
    return pool_moments((valid.sum(), mean, torch.zeros_like(mean)))[0][1]


def pooled_normalise(x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Returns x minus its mean over all ranks, divided by its deviation; 0 where invalid."""
    (moments,) = pool_moments(*masked_moments(valid, x))
    return normalise_masked(x, valid, moments)


def explained_variance(
    value: torch.Tensor, targets: torch.Tensor, valid: torch.Tensor
) -> torch.Tensor:
    """Returns the fraction of the targets' variance that a value explains: 1 is a perfect
    prediction up to a constant, 0 is as good as predicting the mean, negative is worse.
    """
    error, spread = targets - value, targets - masked_mean(targets, valid)
    error = error - masked_mean(error, valid)
    error, spread = (masked_mean(x.square(), valid) for x in (error, spread))
    return 1 - error / torch.maximum(spread, 1e-8 * error).clamp(min=1e-30)


def effective_sample_size(weights: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Returns the effective sample size (Kish 1965) as a fraction of the number of valid entries: 1
    if all weights (>= 0) are equal, 1/n if one of n has all the weight, 0 if none is valid.
    """
    mean, square = masked_mean(weights, valid), masked_mean(weights.square(), valid)
    return mean.square() / square.clamp(min=torch.finfo(square.dtype).tiny)
