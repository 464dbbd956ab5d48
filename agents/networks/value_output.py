"""The output that predicts returns, in a scale that follows them.

Axes: `...` any leading axes, such as (B,) lanes or (T, B) time and lanes.
"""

import torch
from torch import nn

from megastep.agents.networks.precision import compute_dtype
from megastep.agents.networks.running_norm import mixed_moments, store


class ValueOutput(nn.Module):
    """The expected return, (..., width) -> (...,) float32, in units of reward.

    The layer itself predicts returns less their running mean, over their running standard
    deviation, so that its error is about 1 whatever an environment pays. `update_stats` moves both
    and corrects the layer so that no prediction changes (PopArt, van Hasselt et al. 2016).
    """

    def __init__(self, width: int, min_scale: float = 1e-3):
        super().__init__()
        self.core = nn.Linear(width, 1)
        nn.init.orthogonal_(self.core.weight, gain=0.1)
        nn.init.zeros_(self.core.bias)
        self.min_scale = min_scale  # returns that vary less than this are taken for constant
        for name, start in dict(mean=0.0, scale=1.0, count=0.0).items():
            self.register_buffer(name, torch.tensor(start))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        predicted = self.core(x.to(compute_dtype(self.core.weight))).float().squeeze(-1)
        return predicted * self.scale + self.mean

    @torch.no_grad()
    def update_stats(
        self, targets: torch.Tensor, valid: torch.Tensor, min_rate: float = 0.05
    ) -> None:
        """Takes returns (...,) into account where `valid`, the n-th call with weight
        max(min_rate, 1/n). Changes nothing if none is, or if their mean or variance is not finite.
        """
        n_valid = valid.sum()
        n = n_valid.clamp(min=1)
        mean = targets.masked_fill(~valid, 0.0).sum() / n
        variance = (targets - mean).square().masked_fill(~valid, 0.0).sum() / n
        count = self.count + 1
        mean, scale = mixed_moments(self, mean, variance, (1 / count).clamp(min=min_rate, max=1.0))
        weight = self.core.weight * (self.scale / scale)
        bias = (self.core.bias * self.scale + (self.mean - mean)) / scale
        is_taken = (n_valid > 0) & (mean + scale).isfinite()
        old = self.core.weight, self.core.bias, self.mean, self.scale, self.count
        store(is_taken, zip(old, (weight, bias, mean, scale, count), strict=True))
