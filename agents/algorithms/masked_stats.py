"""Statistics over the valid: what they leave out may hold any number, nan too.

Axes: any, the same for numbers and for `valid`, which is bool.
"""

import torch


def masked_mean(x: torch.Tensor, valid: torch.Tensor, axis: int | None = None) -> torch.Tensor:
    """The mean of x where valid, of all or along an axis; 0 where nothing is."""
    return x.masked_fill(~valid, 0.0).sum(axis) / valid.sum(axis).clamp(min=1)


def normalised(x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """x less its mean, over its standard deviation, both over the valid; 0 elsewhere."""
    centred = (x - masked_mean(x, valid)).masked_fill(~valid, 0.0)
    return centred / (masked_mean(centred.square(), valid).sqrt() + 1e-8)


def explained_variance(
    value: torch.Tensor, targets: torch.Tensor, valid: torch.Tensor
) -> torch.Tensor:
    """How much of the targets' variance the value explains: 1 all, 0 no more than their mean,
    negative: less than it.
    """
    error, spread = targets - value, targets - masked_mean(targets, valid)
    error = error - masked_mean(error, valid)
    return 1 - masked_mean(error.square(), valid) / masked_mean(spread.square(), valid).clamp(
        min=1e-8
    )


def effective_sample_size(weights: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """The effective sample size of weights >= 0 (Kish 1965), as a share of the number of the valid:
    1 if all weigh the same, 1/n if one of n weighs alone; 0 where nothing is valid.
    """
    mean, square = masked_mean(weights, valid), masked_mean(weights.square(), valid)
    return mean.square() / square.clamp(min=torch.finfo(square.dtype).tiny)
