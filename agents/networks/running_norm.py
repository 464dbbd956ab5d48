"""Normalisation by running means and standard deviations, in whatever units the numbers are.
Ignores non-finite numbers.

B lanes; `...` any further axes.
"""

from collections.abc import Iterable, Sequence
from typing import Protocol

import torch
from torch import nn

from megastep import spaces
from megastep.agents.networks.kernels import moments as kernels
from megastep.agents.networks.kernels.library import LIBRARY
from megastep.agents.types import Moments
from megastep.types import Space

#: The version of the rules below. A run that began with others cannot continue bit for bit.
VERSION = 2
#: The scale of a number that has not varied yet, which makes it 0.
UNKNOWN_SCALE = LIBRARY.constants["UNKNOWN_SCALE"]
#: A standard deviation below this fraction of the mean may be rounding errors.
RESOLUTION = LIBRARY.constants["RESOLUTION"]


class _Statistics(Protocol):
    mean: torch.Tensor
    scale: torch.Tensor


class RunningNorm(nn.Module):
    """Subtracts a running mean and divides by a running standard deviation: per channel for images,
    per number for vectors. A number that has not varied yet becomes 0: nothing tells by how much
    to divide when it does.

    Needed also for images from 0 to 1: if pixels are .87 plus or minus .1, a new network would
    mostly see the .87.

    Before the first moments, observations stay as they are, or are 0 after `clear`.

    Args:
        space: leaf space of an image or a vector.
    """

    mean: torch.Tensor
    scale: torch.Tensor
    count: torch.Tensor  # ()

    def __init__(self, space: Space):
        super().__init__()
        is_image = isinstance(space, spaces.MultiImage)
        shape = (*space.shape[:2], 1, 1) if is_image else space.shape
        self.pooled_axes = (0, -2, -1) if is_image else (0,)
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("scale", torch.ones(shape))
        self.register_buffer("count", torch.tensor(0.0))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return (obs - self.mean) / self.scale

    def clear(self) -> None:
        """Makes observations 0 until the first moments, unless it has some: in their own units they
        could be of any size.
        """
        self.scale.masked_fill_(self.count == 0, UNKNOWN_SCALE)

    @torch.no_grad()
    def moments(self, obs: torch.Tensor, is_counted: torch.Tensor | bool = True) -> Moments:
        """Returns the number of lanes that count, and the mean and variance of their observations.

        Args:
            obs: (B, ...).
            is_counted: () or (B,) bool, lanes to count.
        """
        lanes = torch.ones(len(obs), dtype=torch.bool, device=obs.device) & is_counted
        is_masked = ~lanes.view(-1, *[1] * (obs.dim() - 1))
        n_lanes = lanes.sum()
        n = n_lanes.clamp(min=1) * (obs[0].numel() // self.mean.numel())
        mean = obs.float().masked_fill(is_masked, 0.0).sum(self.pooled_axes, keepdim=True) / n
        error = (obs.float() - mean).masked_fill(is_masked, 0.0)
        variance = error.square().sum(self.pooled_axes, keepdim=True) / n
        return n_lanes, mean[0], variance[0]

    @torch.no_grad()
    def add(self, n_lanes: torch.Tensor, mean: torch.Tensor, variance: torch.Tensor) -> None:
        """Adds moments to the statistics, the n-th call with weight 1/n.

        Changes nothing if no lane was counted, or if a mean or variance is not finite.
        """
        count = self.count + 1
        mean, scale = mix_moments(self, mean, variance, 1 / count)
        scale = scale.masked_fill(scale <= RESOLUTION * mean.abs(), UNKNOWN_SCALE)
        is_stored = (n_lanes > 0) & (mean + scale).isfinite().all()
        store_if(is_stored, [(self.mean, mean), (self.scale, scale), (self.count, count)])


@torch.no_grad()
def moments_of(
    norms: Sequence[RunningNorm],
    leaves: Sequence[torch.Tensor],
    is_counted: torch.Tensor | bool = True,
) -> list[Moments]:
    """Returns `RunningNorm.moments` of each norm; on a GPU in one kernel for up to `MAX_LEAVES`.

    Args:
        leaves: the observations (B, ...) of each norm.
        is_counted: () or (B,) bool, lanes to count.
    """
    pairs = list(zip(norms, leaves, strict=True))
    if not all(_is_fused(norm) and _is_readable(leaf) for norm, leaf in pairs):
        return [norm.moments(leaf, is_counted) for norm, leaf in pairs]
    moments = []
    for start in range(0, len(pairs), kernels.MAX_LEAVES):
        some = pairs[start : start + kernels.MAX_LEAVES]
        n_lanes, means, variances = kernels.moments(
            [obs.flatten(1) for _, obs in some],
            [norm.mean.numel() for norm, _ in some],
            torch.as_tensor(is_counted, device=some[0][1].device).expand(len(some[0][1])),
        )
        moments += [
            (n_lanes, mean.view_as(norm.mean), variance.view_as(norm.mean))
            for (norm, _), mean, variance in zip(some, means, variances, strict=True)
        ]
    return moments


@torch.no_grad()
def add_moments(
    norms: Sequence[RunningNorm], moments: Sequence[Moments], is_counted: torch.Tensor | None = None
) -> None:
    """Does `RunningNorm.add` for each norm; on a GPU in one kernel for up to `MAX_LEAVES`.

    Args:
        moments: of each norm.
        is_counted: () bool; if false, nothing changes. None: true.
    """
    if all(map(_is_fused, norms)):
        for start in range(0, len(norms), kernels.MAX_LEAVES):
            some = slice(start, start + kernels.MAX_LEAVES)
            kernels.add_moments(norms[some], moments[some], is_counted)
        return
    for norm, (n_lanes, mean, variance) in zip(norms, moments, strict=True):
        norm.add(n_lanes if is_counted is None else n_lanes * is_counted, mean, variance)


def _is_fused(norm) -> bool:
    return norm.mean.is_cuda and norm.mean.dtype == torch.float32


def _is_readable(leaf) -> bool:
    is_float = leaf.dtype in (torch.float16, torch.float32)
    return leaf.is_cuda and is_float and leaf.is_contiguous()


def mix_moments(
    norm: _Statistics, mean: torch.Tensor, variance: torch.Tensor, rate: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns mean and standard deviation of a mixture: the norm's moments with weight 1 - rate,
    `mean` and `variance` with weight rate.
    """
    old_variance = norm.scale.masked_fill(norm.scale >= UNKNOWN_SCALE, 0.0).square()
    spread = rate * (1 - rate) * (mean - norm.mean).square()
    variance = old_variance.lerp(variance, rate) + spread
    return norm.mean.lerp(mean, rate), variance.sqrt()


def store_if(condition: torch.Tensor, pairs: Iterable[tuple[torch.Tensor, torch.Tensor]]) -> None:
    """Copies the second tensor of each pair into the first if `condition`, a bool (); otherwise
    changes no bit. Never synchronises.
    """
    for target, source in pairs:
        target.copy_(torch.where(condition, source, target))
