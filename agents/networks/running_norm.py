"""Running means and standard deviations, which never take in what is not finite.

Axes: B lanes, `...` any more.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import nn

from megastep import spaces


class RunningNorm(nn.Module):
    """Images less their channels' running mean, over their running standard deviation; vectors
    likewise, number by number.

    An image's numbers may well be .87 plus or minus .1, of which a network with its first weights
    would see mostly the .87.
    """

    def __init__(self, space: Any, min_scale: float = 1e-2):
        super().__init__()
        is_image = isinstance(space, spaces.MultiImage)
        shape = (*space.shape[:2], 1, 1) if is_image else space.shape
        self.pooled = (0, -2, -1) if is_image else (0,)
        self.min_scale = min_scale  # what varies less than this is not enlarged any further
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("scale", torch.ones(shape))
        self.register_buffer("count", torch.tensor(0.0))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return (obs - self.mean) / self.scale

    @torch.no_grad()
    def update_stats(self, obs: torch.Tensor, taken: torch.Tensor | bool = True) -> None:
        """Takes observations (B, ...) into account, or those `taken`, () or (B,) bool; the n-th
        call with weight 1/n. Changes nothing if none is, or if a mean or variance is not finite.
        """
        lanes = torch.ones(len(obs), dtype=torch.bool, device=obs.device) & taken
        left_out = ~lanes.view(-1, *[1] * (obs.dim() - 1))
        n_lanes = lanes.sum()
        n = n_lanes.clamp(min=1) * (obs[0].numel() // self.mean.numel())
        mean = obs.float().masked_fill(left_out, 0.0).sum(self.pooled, keepdim=True) / n
        error = (obs - mean).masked_fill(left_out, 0.0)
        variance = error.square().sum(self.pooled, keepdim=True) / n
        count = self.count + 1
        mean, scale = mixed_moments(self, mean[0], variance[0], 1 / count)
        is_taken = (n_lanes > 0) & (mean + scale).isfinite().all()
        store(is_taken, [(self.mean, mean), (self.scale, scale), (self.count, count)])


def mixed_moments(
    norm: nn.Module,
    mean: torch.Tensor,
    variance: torch.Tensor,
    rate: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The mean and scale of a mixture: a norm's own with weight 1 - rate, and another mean and
    variance with weight rate.
    """
    own = norm.scale.square()
    spread = rate * (1 - rate) * (mean - norm.mean).square()
    variance = own.lerp(variance, rate) + spread
    return norm.mean.lerp(mean, rate), variance.sqrt().clamp(min=norm.min_scale)


def store(is_taken: torch.Tensor, pairs: Iterable[tuple[torch.Tensor, torch.Tensor]]) -> None:
    """Gives tensors their new values in place, or, unless `is_taken`, leaves every bit as it is."""
    for old, new in pairs:
        old.copy_(torch.where(is_taken, new, old))
