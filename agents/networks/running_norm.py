"""Normalisation by running means and standard deviations, in whatever units the numbers are, which
ignores non-finite numbers; and by those of numbers of which some are valid.

B lanes; `...` any further axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import nn

from megastep import spaces
from megastep.agents.networks.fused import LIBRARY, fused, is_plain_on_gpu
from megastep.kernels.build.launch import Blocks, launch
from megastep.types import Space

if TYPE_CHECKING:
    from megastep.agents.types import Moments

#: The scale of a number that has not varied yet, which makes it 0.
UNKNOWN_SCALE = LIBRARY.constants["UNKNOWN_SCALE"]
#: A standard deviation below this fraction of the mean may be rounding errors.
RESOLUTION = LIBRARY.constants["RESOLUTION"]
#: Leaves of an observation that a kernel handles.
MAX_LEAVES = LIBRARY.constants["MAX_LEAVES"]
_LANES, _THREADS = LIBRARY.constants["MOMENTS_LANES"], LIBRARY.constants["MOMENTS_THREADS"]
_MAX_ARRAYS, _MASKED_THREADS, _NUMBERS = (
    LIBRARY.constants[f"MASKED_{name}"] for name in ("ARRAYS", "THREADS", "NUMBERS")
)
_TINY = 1e-30  # so that equal numbers are not divided by 0


class RunningNorm(nn.Module):
    """Subtracts a running mean and divides by a running standard deviation: per channel for images,
    per number for vectors. A number that has not varied yet becomes 0: nothing tells by how much
    to divide when it does. Before the first moments, observations stay as they are, or are 0 after
    `clear`.
    """

    mean: torch.Tensor
    scale: torch.Tensor
    count: torch.Tensor  # ()

    def __init__(self, space: Space):
        super().__init__()
        is_image = isinstance(space, spaces.MultiImage)
        shape = (*space.shape[:2], 1, 1) if is_image else space.shape
        self.pooled_axes = (0, -2, -1) if is_image else (0,)
        start = dict(mean=torch.zeros(shape), scale=torch.ones(shape), count=torch.tensor(0.0))
        for name, tensor in start.items():
            self.register_buffer(name, tensor)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return (obs - self.mean) / self.scale

    def clear(self) -> None:
        """Makes observations, which may be of any size, 0 until the first moments."""
        self.scale.masked_fill_(self.count == 0, UNKNOWN_SCALE)


def packed_leaf(norm: RunningNorm, flat: torch.Tensor) -> bytes:
    """Returns a leaf (..., F) float16 or float32 and its statistics, as kernels take them."""
    n_features = flat.shape[-1]
    return LIBRARY.params.IntakeLeafParams(
        **dict(values=flat, mean=norm.mean, scale=norm.scale, n_features=n_features),
        **dict(group=n_features // norm.mean.numel(), is_half=int(flat.dtype == torch.float16)),
    )


def are_readable(leaves: Iterable[torch.Tensor]) -> bool:
    """Returns whether kernels read these leaves."""
    return all(
        leaf.is_cuda and leaf.is_contiguous() and leaf.dtype in (torch.float16, torch.float32)
        for leaf in leaves
    )


def _moments_on_gpu(norms, leaves, is_counted=True) -> list[Moments]:
    device, n_lanes = leaves[0].device, len(leaves[0])
    is_counted = torch.ones(n_lanes, dtype=torch.bool, device=device) & is_counted
    sizes = [norm.mean.numel() for norm in norms]
    parts = torch.empty(sum(sizes), -(-n_lanes // _LANES), 3, device=device)
    flat = [leaf.flatten(1) for leaf in leaves]
    blocks = Blocks(parts.shape[1], len(parts), _MASKED_THREADS)
    leaves_of = b"".join(map(packed_leaf, norms, flat))
    fields = dict(leaves=leaves_of, is_counted=is_counted, parts=parts, n_lanes=n_lanes)
    launch(LIBRARY, "moments", device, blocks, **fields)
    n_counted, moments = _merged(parts)
    means, variances = (
        [part.view_as(norm.mean) for part, norm in zip(row.split(sizes), norms)] for row in moments
    )
    return [(n_counted, *pair) for pair in zip(means, variances)]


def _merged(parts) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the number of valid entries and means and variances (2, n) of parts (n, parts, 3)."""
    moments = parts.new_empty(2, len(parts))
    n_valid = torch.empty((), dtype=torch.int64, device=parts.device)
    fields = dict(parts=parts, moments=moments, n_valid=n_valid, n_parts=parts.shape[1])
    blocks = Blocks(1, len(parts), _MASKED_THREADS)
    launch(LIBRARY, "masked_moments", parts.device, blocks, **fields)
    return n_valid, moments


@torch.no_grad()
@fused(
    _moments_on_gpu,
    lambda norms, leaves, *_: (
        0 < len(leaves) <= MAX_LEAVES
        and are_readable(leaves)
        and is_plain_on_gpu(*(norm.mean for norm in norms))
    ),
)
def moments_of(
    norms: Sequence[RunningNorm],
    leaves: Sequence[torch.Tensor],
    is_counted: torch.Tensor | bool = True,
) -> list[Moments]:
    """Returns of each norm and its observations (B, ...) the number of lanes that count, () or (B,)
    bool, and mean and variance of these.
    """
    moments: list[Moments] = []
    for norm, obs in zip(norms, leaves, strict=True):
        lanes = torch.ones(len(obs), dtype=torch.bool, device=obs.device) & is_counted
        is_masked = ~lanes.view(-1, *[1] * (obs.dim() - 1))
        n_lanes = lanes.sum()
        n = n_lanes.clamp(min=1) * (obs[0].numel() // norm.mean.numel())
        mean = obs.float().masked_fill(is_masked, 0.0).sum(norm.pooled_axes, keepdim=True) / n
        error = (obs.float() - mean).masked_fill(is_masked, 0.0)
        variance = error.square().sum(norm.pooled_axes, keepdim=True) / n
        moments.append((n_lanes, mean[0], variance[0]))
    return moments


def _add_on_gpu(norms, moments, is_counted=None) -> None:
    moments = [
        (n.long(), mean.contiguous(), variance.contiguous()) for n, mean, variance in moments
    ]
    rows = [
        LIBRARY.params.RunningNormParams(
            **dict(mean=norm.mean, scale=norm.scale, count=norm.count, n=mean.numel()),
            **dict(n_counted=n_counted, new_mean=mean, new_variance=variance),
        )
        for norm, (n_counted, mean, variance) in zip(norms, moments, strict=True)
    ]
    blocks = Blocks(len(rows), threads=_THREADS)
    fields = dict(norms=b"".join(rows), is_counted=is_counted)
    launch(LIBRARY, "add_moments", norms[0].mean.device, blocks, **fields)


@torch.no_grad()
@fused(
    _add_on_gpu,
    lambda norms, *_: (
        0 < len(norms) <= MAX_LEAVES and is_plain_on_gpu(*(norm.mean for norm in norms))
    ),
)
def add_moments(
    norms: Sequence[RunningNorm], moments: Sequence[Moments], is_counted: torch.Tensor | None = None
) -> None:
    """Adds moments to the statistics of each norm, the n-th call with weight 1/n. Changes nothing
    if no lane was counted, a mean or variance is not finite, or `is_counted`, () bool, is false.
    """
    for norm, (n_lanes, mean, variance) in zip(norms, moments, strict=True):
        n_lanes = n_lanes if is_counted is None else n_lanes * is_counted
        count = norm.count + 1
        mean, scale = mix_moments(norm.mean, norm.scale, mean, variance, 1 / count)
        scale = scale.masked_fill(scale <= RESOLUTION * mean.abs(), UNKNOWN_SCALE)
        is_stored = (n_lanes > 0) & (mean + scale).isfinite().all()
        store_if(is_stored, [(norm.mean, mean), (norm.scale, scale), (norm.count, count)])


def mix_moments(
    old_mean: torch.Tensor,
    old_scale: torch.Tensor,
    mean: torch.Tensor,
    variance: torch.Tensor,
    rate: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns mean and standard deviation of old moments with weight 1 - rate, and others."""
    old_variance = old_scale.masked_fill(old_scale >= UNKNOWN_SCALE, 0.0).square()
    spread = rate * (1 - rate) * (mean - old_mean).square()
    variance = old_variance.lerp(variance, rate) + spread
    return old_mean.lerp(mean, rate), variance.sqrt()


def store_if(condition: torch.Tensor, pairs: Iterable[tuple[torch.Tensor, torch.Tensor]]) -> None:
    """Copies the second tensor of each pair into the first if `condition`, () bool."""
    for target, source in pairs:
        target.copy_(torch.where(condition, source, target))


# ---- Numbers of which some are valid; those that are not may be anything ----


def _are_masked_readable(valid, *arrays) -> bool:
    is_small = all(x.numel() < 2**31 and x.shape == valid.shape for x in arrays)
    return is_small and is_plain_on_gpu(*arrays) and valid.is_contiguous()


def _masked_on_gpu(valid, *arrays) -> list[Moments]:
    n, tensor = arrays[0].numel(), arrays[0]
    n_parts = max(1, -(-n // (_MASKED_THREADS * _NUMBERS)))
    parts = tensor.new_empty(len(arrays), n_parts, 3)
    rows = b"".join(LIBRARY.params.MaskedArrayParams(values=array) for array in arrays)
    blocks = Blocks(n_parts, len(arrays), _MASKED_THREADS)
    fields = dict(arrays=rows, valid=valid, parts=parts, n=n)
    launch(LIBRARY, "masked_parts", tensor.device, blocks, **fields)
    n_valid, moments = _merged(parts)
    return [(n_valid, *pair) for pair in zip(*(row.unbind() for row in moments))]


@torch.no_grad()
@fused(
    _masked_on_gpu,
    lambda valid, *arrays: len(arrays) <= _MAX_ARRAYS and _are_masked_readable(valid, *arrays),
)
def masked_moments(valid: torch.Tensor, *arrays: torch.Tensor) -> list[Moments]:
    """Returns the number of valid entries, bool, and their mean and variance in each array of their
    shape, 0 if none is valid.
    """
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
    return (x - mean).masked_fill(~valid, 0.0) / (variance.sqrt() + _TINY)
