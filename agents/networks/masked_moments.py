"""Means and variances of numbers of which some are valid, and normalisation by them.

`valid` is a bool tensor of the shape of the numbers, which may be anything where it is false.
"""

import torch

from megastep.agents.networks.fused import LIBRARY, fused, is_plain_on_gpu
from megastep.agents.types import Moments
from megastep.kernels.build.launch import Blocks, launch

_MAX_ARRAYS, _THREADS, _NUMBERS = (
    LIBRARY.constants[f"MASKED_{name}"] for name in ("ARRAYS", "THREADS", "NUMBERS")
)
_TINY = 1e-30  # so that equal numbers are not divided by 0


def _are_readable(valid, *arrays) -> bool:
    is_small = all(x.numel() < 2**31 and x.shape == valid.shape for x in arrays)
    return is_small and is_plain_on_gpu(*arrays) and valid.is_contiguous()


def _moments_on_gpu(valid, *arrays) -> list[Moments]:
    """Computes parts of the arrays, then adds them up."""
    n, tensor = arrays[0].numel(), arrays[0]
    n_parts = max(1, -(-n // (_THREADS * _NUMBERS)))
    parts = tensor.new_empty(len(arrays), n_parts, 3)
    moments = tensor.new_empty(len(arrays), 2)
    n_valid = torch.empty((), dtype=torch.int64, device=tensor.device)
    rows = b"".join(LIBRARY.params.MaskedArrayParams(values=array) for array in arrays)
    blocks = Blocks(n_parts, len(arrays), _THREADS)
    fields = dict(arrays=rows, valid=valid, parts=parts, n=n)
    launch(LIBRARY, "masked_parts", tensor.device, blocks, **fields)
    fields = dict(parts=parts, moments=moments, n_valid=n_valid, n_parts=n_parts)
    launch(LIBRARY, "masked_moments", tensor.device, blocks._replace(x=1), **fields)
    return [(n_valid, *pair.unbind()) for pair in moments]


@torch.no_grad()
@fused(
    _moments_on_gpu,
    lambda valid, *arrays: len(arrays) <= _MAX_ARRAYS and _are_readable(valid, *arrays),
)
def masked_moments(valid: torch.Tensor, *arrays: torch.Tensor) -> list[Moments]:
    """Returns the number of valid entries, and their mean and variance in each array, 0 if none is
    valid.

    Args:
        valid: bool.
        arrays: of the same shape.
    """
    n_valid = valid.sum()
    n = n_valid.clamp(min=1)
    moments = []
    for x in arrays:
        mean = x.masked_fill(~valid, 0.0).sum() / n
        variance = (x - mean).square().masked_fill(~valid, 0.0).sum() / n
        moments.append((n_valid, mean, variance))
    return moments


def _normalise_on_gpu(x, valid, moments) -> torch.Tensor:
    _, mean, variance = moments
    normalised = torch.empty_like(x)
    launch(
        *(LIBRARY, "normalise_masked", x.device, x.numel()),
        **dict(values=x, valid=valid, mean=mean, variance=variance),
        **dict(normalised=normalised, n=x.numel()),
    )
    return normalised


@torch.no_grad()
@fused(_normalise_on_gpu, lambda x, valid, moments: _are_readable(valid, x))
def normalise_masked(x: torch.Tensor, valid: torch.Tensor, moments: Moments) -> torch.Tensor:
    """Returns x minus the mean, divided by the standard deviation; 0 where invalid."""
    _, mean, variance = moments
    return (x - mean).masked_fill(~valid, 0.0) / (variance.sqrt() + _TINY)
