"""The value: predicts the return in numbers normalised by running statistics of returns (PopArt).

`...` any axes, such as (B,) lanes or (T, B) time and lanes.
"""

import torch
from torch import nn

from megastep.agents.distributed.pooling import pool_moments
from megastep.agents.networks.fused import LIBRARY, fused, is_plain_on_gpu
from megastep.agents.networks.linear import linear
from megastep.agents.networks.running_norm import RESOLUTION, masked_moments, mix_moments, store_if
from megastep.agents.types import Moments
from megastep.kernels.build.launch import Blocks, launch

_THREADS = LIBRARY.constants["MASKED_THREADS"]
_MIN_RATE = 0.05  # smallest weight of a rollout's returns in their statistics
_MIN_SCALE = 1e-15  # far below the standard deviation of returns in any units, and not 0


def _add_on_gpu(output, moments, is_counted=None) -> None:
    n_valid, mean, variance = moments
    launch(
        *(LIBRARY, "add_returns", output.mean.device, Blocks(1, threads=_THREADS)),
        **dict(weight=output.linear.weight, bias=output.linear.bias),
        **dict(mean=output.mean, scale=output.scale, count=output.count),
        **dict(new_mean=mean, new_variance=variance, n_valid=n_valid, is_counted=is_counted),
        **dict(width=output.linear.in_features, min_rate=_MIN_RATE, min_scale=_MIN_SCALE),
    )


class ValueOutput(nn.Module):
    """Predicts the return: (..., width) -> (...,) float32, in units of reward.

    The linear layer predicts returns normalised by their running mean and standard deviation, so
    its error is about 1 whatever the size of rewards. `update_stats` moves both statistics and
    corrects the layer so that no prediction changes (PopArt, van Hasselt et al. 2016).
    """

    mean: torch.Tensor  # ()
    scale: torch.Tensor
    count: torch.Tensor

    def __init__(self, width: int):
        super().__init__()
        self.linear = nn.Linear(width, 1)
        nn.init.orthogonal_(self.linear.weight, gain=0.1)
        nn.init.zeros_(self.linear.bias)
        for name, start in dict(mean=0.0, scale=1.0, count=0.0).items():
            self.register_buffer(name, torch.tensor(start))

    @torch.no_grad()
    def clear(self) -> None:
        """Makes predictions 0, unless there are statistics of returns: those of a new network may
        be many times the size of returns, and PopArt would keep them.
        """
        for parameter in self.linear.parameters():
            parameter.masked_fill_(self.count == 0, 0.0)

    @property
    def is_clear(self) -> torch.Tensor:
        """Whether there have been no statistics since `clear`: () bool."""
        return (self.count == 0) & ~self.linear.weight.any() & ~self.linear.bias.any()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        normalised = linear(x, self.linear).float().squeeze(-1)
        return normalised * self.scale + self.mean

    def update_stats(self, targets: torch.Tensor, valid: torch.Tensor) -> None:
        """Adds valid returns (...,) to the statistics, those of all ranks together; see `add`."""
        (moments,) = pool_moments(*masked_moments(valid, targets))
        self.add(moments)

    @torch.no_grad()
    @fused(_add_on_gpu, lambda self, *_: is_plain_on_gpu(self.mean, *self.linear.parameters()))
    def add(self, moments: Moments, is_counted: torch.Tensor | None = None) -> None:
        """Adds moments of returns to the statistics, the n-th call with weight max(0.05, 1/n).
        Changes nothing if there is no return, if mean or variance is not finite, if all returns
        have been 0, which tells nothing about their size, or if `is_counted`, () bool, is false.
        """
        n_valid, mean, variance = moments
        count = self.count + 1
        rate = (1 / count).clamp(min=_MIN_RATE, max=1.0)
        mean, scale = mix_moments(self.mean, self.scale, mean, variance, rate)
        is_nothing = (self.count == 0) & (scale == 0) & (mean == 0)
        scale = torch.maximum(scale, (RESOLUTION * mean.abs()).clamp(min=_MIN_SCALE))
        weight = self.linear.weight * (self.scale / scale)
        bias = (self.linear.bias * self.scale + (self.mean - mean)) / scale
        is_stored = (n_valid > 0) & (mean + scale).isfinite() & ~is_nothing
        if is_counted is not None:
            is_stored = is_stored & is_counted
        old = self.linear.weight, self.linear.bias, self.mean, self.scale, self.count
        store_if(is_stored, zip(old, (weight, bias, mean, scale, count), strict=True))
