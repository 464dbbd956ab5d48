"""Statistics over valid entries. Invalid entries may hold anything, NaN included.

`valid` is a bool tensor of the shape of the numbers.
"""

from collections.abc import Sequence

import torch

from megastep.agents.algorithms.kernels import program
from megastep.agents.distributed.pooling import Moments, masked_moments, pool_moments

_MAX_QUANTITIES = program.PROGRAM.constants["MOMENTS_QUANTITIES"]
_MAX_SIZE = 2**31


def masked_mean(x: torch.Tensor, valid: torch.Tensor, axis: int | None = None) -> torch.Tensor:
    """Returns the mean of the valid entries, overall or along an axis; 0 if none is valid."""
    return x.masked_fill(~valid, 0.0).sum(axis) / valid.sum(axis).clamp(min=1)


def pooled_mean(x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Returns the mean of the valid entries of all ranks."""
    mean = masked_mean(x, valid)
    return pool_moments((valid.sum(), mean, torch.zeros_like(mean)))[0][1]


def pooled_moments(tensors: Sequence[torch.Tensor], valid: torch.Tensor) -> Moments:
    """Returns the number of valid entries () of all ranks, and the mean and the variance of each of
    K tensors, (K,). On a GPU in two kernels.
    """
    is_fused = valid.is_cuda and len(tensors) <= _MAX_QUANTITIES and 0 < valid.numel() < _MAX_SIZE
    if is_fused and all(x.dtype == torch.float32 for x in tensors):
        moments = _moments_on_gpu(tensors, valid)
    else:
        moments = masked_moments(torch.stack([*tensors]), valid)
    return pool_moments(moments)[0]


def _moments_on_gpu(tensors, valid):
    """Returns `masked_moments` of tensors."""
    tensors, valid = [x.contiguous() for x in tensors], valid.contiguous()
    threads, n_numbers = (program.PROGRAM.constants[f"MOMENTS_{x}"] for x in ("THREADS", "NUMBERS"))
    n_quantities, n_blocks = len(tensors), -(-valid.numel() // (threads * n_numbers))
    parts = tensors[0].new_empty(n_quantities, n_blocks, 3)
    means, variances = tensors[0].new_empty(2, n_quantities)
    n_valid = torch.empty((), dtype=torch.int64, device=valid.device)
    quantity = program.PROGRAM.params.QuantityParams
    program.run(
        "block_moments",
        valid.device,
        n_blocks * threads,
        n_blocks_y=n_quantities,
        block=threads,
        quantities=b"".join(quantity(values=x.data_ptr()) for x in tensors),
        valid=valid,
        parts=parts,
        n_entries=valid.numel(),
    )
    program.run(
        "join_moments",
        valid.device,
        threads,
        n_blocks_y=n_quantities,
        block=threads,
        parts=parts,
        means=means,
        variances=variances,
        n_valid=n_valid,
        n_blocks=n_blocks,
    )
    return n_valid, means, variances


def pooled_normalise(x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Returns x minus its mean over all ranks, divided by its standard deviation there; 0 where
    invalid.
    """
    _, (mean,), (variance,) = pooled_moments([x], valid)
    return normalise(x, valid, mean, variance)


def normalise(
    x: torch.Tensor, valid: torch.Tensor, mean: torch.Tensor, variance: torch.Tensor
) -> torch.Tensor:
    """Returns x minus its mean, divided by its standard deviation; 0 where invalid."""
    return (x - mean).masked_fill(~valid, 0.0) / (variance.sqrt() + 1e-8)


def explained_variance(
    value: torch.Tensor, targets: torch.Tensor, valid: torch.Tensor
) -> torch.Tensor:
    """Returns the fraction of the targets' variance that a value explains.

    1 is a perfect prediction up to a constant, 0 is as good as predicting the mean, negative is
    worse than that.
    """
    error, spread = targets - value, targets - masked_mean(targets, valid)
    error = error - masked_mean(error, valid)
    return 1 - masked_mean(error.square(), valid) / masked_mean(spread.square(), valid).clamp(
        min=1e-8
    )


def effective_sample_size(weights: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Returns the effective sample size (Kish 1965) as a fraction of the number of valid entries.

    1 if all weights (>= 0) are equal, 1/n if one of n has all the weight, 0 if none is valid.
    """
    mean, square = masked_mean(weights, valid), masked_mean(weights.square(), valid)
    return mean.square() / square.clamp(min=torch.finfo(square.dtype).tiny)
