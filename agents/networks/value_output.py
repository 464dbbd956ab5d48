"""The critic's output layer, which predicts returns normalised by running statistics (PopArt).

`...` any leading axes, such as (B,) lanes or (T, B) time and lanes.
"""

import torch
from torch import nn

from megastep.agents.distributed.pooling import pool_moments
from megastep.agents.networks.kernels import heads as kernels
from megastep.agents.networks.kernels import moments as statistics
from megastep.agents.networks.kernels.library import aligned
from megastep.agents.networks.layers import linear
from megastep.agents.networks.masked_moments import masked_moments
from megastep.agents.networks.precision import compute_dtype
from megastep.agents.networks.running_norm import RESOLUTION, mix_moments, store_if
from megastep.agents.types import Moments


class ValueOutput(nn.Module):
    """Predicts the return: (..., width) -> (...,) float32, in units of reward.

    The linear layer predicts returns normalised by their running mean and standard deviation, so
    its error is about 1 whatever the size of rewards. `update_stats` moves both statistics and
    corrects the layer so that no prediction changes (PopArt, van Hasselt et al. 2016).

    Args:
        width: number of features.
        min_scale: smallest standard deviation, far below that of returns in any units, and not 0.
    """

    mean: torch.Tensor  # ()
    scale: torch.Tensor
    count: torch.Tensor

    def __init__(self, width: int, min_scale: float = 1e-15):
        super().__init__()
        self.linear = nn.Linear(width, 1)
        nn.init.orthogonal_(self.linear.weight, gain=0.1)
        nn.init.zeros_(self.linear.bias)
        self.min_scale = min_scale
        for name, start in dict(mean=0.0, scale=1.0, count=0.0).items():
            self.register_buffer(name, torch.tensor(start))

    @torch.no_grad()
    def clear(self) -> None:
        """Makes predictions 0, unless there are statistics of returns: whatever a new network
        predicts may be many times the size of returns, and PopArt would keep it.
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

    def is_fused(self, x: torch.Tensor) -> bool:
        """Returns whether `of_hidden` takes features like x (..., width)."""
        is_bf16 = compute_dtype(self.linear.weight) == torch.bfloat16
        is_bf16 = is_bf16 and self.linear.weight.dtype == torch.float32
        n_rows = x.numel() // max(x.shape[-1], 1)
        is_sized = n_rows <= kernels.MAX_ROWS and not x.shape[-1] % kernels.MULTIPLE
        return x.is_cuda and is_bf16 and is_sized and not torch.is_grad_enabled()

    def of_hidden(self, hidden: torch.Tensor) -> torch.Tensor:
        """Returns `self(hidden.relu())` (...,) in one kernel of a GPU, of (..., width) bfloat16."""
        rows = aligned(hidden.flatten(0, -2))
        return kernels.values(rows, self.fused_value()).view(hidden.shape[:-1])

    def fused_value(self) -> kernels.Value:
        """Returns weight, bias and statistics as kernels take them."""
        weight, bias = (leaf.detach() for leaf in self.linear.parameters())
        return kernels.Value(aligned(weight), bias, self.scale, self.mean)

    def update_stats(self, targets: torch.Tensor, valid: torch.Tensor) -> None:
        """Adds returns to the statistics, those of all ranks together; see `add`.

        Args:
            targets: (...,), returns.
            valid: (...,) bool.
        """
        (moments,) = pool_moments(*masked_moments(valid, targets))
        self.add(moments)

    @torch.no_grad()
    def add(
        self, moments: Moments, is_counted: torch.Tensor | None = None, min_rate: float = 0.05
    ) -> None:
        """Adds moments of returns to the statistics, the n-th call with weight max(min_rate, 1/n).
        On a GPU in one kernel.

        Changes nothing if there is no return, if mean or variance is not finite, or if all returns
        have been 0, which tells nothing about their size.

        Args:
            moments: number of returns, their mean and variance.
            is_counted: () bool; if false, nothing changes. None: true.
            min_rate: smallest weight of a call.
        """
        tensors = *self.linear.parameters(), self.mean
        if all(x.is_cuda and x.dtype == torch.float32 and x.is_contiguous() for x in tensors):
            statistics.add_returns(self, moments, is_counted, min_rate)
            return
        n_valid, mean, variance = moments
        count = self.count + 1
        rate = (1 / count).clamp(min=min_rate, max=1.0)
        mean, scale = mix_moments(self, mean, variance, rate)
        is_nothing = (self.count == 0) & (scale == 0) & (mean == 0)
        scale = torch.maximum(scale, (RESOLUTION * mean.abs()).clamp(min=self.min_scale))
        weight = self.linear.weight * (self.scale / scale)
        bias = (self.linear.bias * self.scale + (self.mean - mean)) / scale
        is_stored = (n_valid > 0) & (mean + scale).isfinite() & ~is_nothing
        if is_counted is not None:
            is_stored = is_stored & is_counted
        old = self.linear.weight, self.linear.bias, self.mean, self.scale, self.count
        store_if(is_stored, zip(old, (weight, bias, mean, scale, count), strict=True))
