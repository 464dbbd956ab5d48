"""Means and variances of numbers of which some are valid, and normalisation by them. On a GPU in
three kernels.

`valid` is a bool tensor of the shape of the numbers, which may be anything where it is false.
"""

import torch

from megastep.agents.networks.kernels import moments as kernels
from megastep.agents.types import Moments

_MAX_NUMBERS = 2**31 - 1
_TINY = 1e-30  # so that equal numbers are not divided by 0


@torch.no_grad()
def masked_moments(valid: torch.Tensor, *arrays: torch.Tensor) -> list[Moments]:
    """Returns the number of valid entries, and their mean and variance in each array, 0 if none is
    valid.

    Args:
        valid: bool.
        arrays: of the same shape.
    """
    if len(arrays) <= kernels.MAX_ARRAYS and _is_fused(valid, *arrays):
        n_valid, moments = kernels.masked_moments(arrays, valid)
        return [(n_valid, mean, variance) for mean, variance in map(torch.unbind, moments)]
    n_valid = valid.sum()
    n = n_valid.clamp(min=1)
    moments = []
    for x in arrays:
        mean = x.masked_fill(~valid, 0.0).sum() / n
        variance = (x - mean).square().masked_fill(~valid, 0.0).sum() / n
        moments.append((n_valid, mean, variance))
    return moments


@torch.no_grad()
def normalise_masked(x: torch.Tensor, valid: torch.Tensor, moments: Moments) -> torch.Tensor:
    """Returns x minus the mean, divided by the standard deviation; 0 where invalid."""
    _, mean, variance = moments
    if _is_fused(valid, x):
        return kernels.normalise_masked(x, valid, mean, variance)
    return (x - mean).masked_fill(~valid, 0.0) / (variance.sqrt() + _TINY)


def _is_fused(valid, *arrays) -> bool:
    """Returns whether kernels can read these tensors."""
    are_floats = all(x.dtype == torch.float32 and x.numel() <= _MAX_NUMBERS for x in arrays)
    return are_floats and all(x.is_cuda and x.is_contiguous() for x in (valid, *arrays))
