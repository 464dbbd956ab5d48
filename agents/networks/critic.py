"""The critic: predicts the return from the actor's features and from privileged observations, in
numbers normalised by running statistics of returns (PopArt).

`...` any leading axes, such as (B,) lanes or (T, B) time and lanes.
"""

from typing import NamedTuple

import torch
from torch import nn

from megastep.agents.distributed.pooling import pool_moments
from megastep.agents.networks.fused import LIBRARY, aligned, fused, is_plain_on_gpu
from megastep.agents.networks.intakes import ConcatIntake
from megastep.agents.networks.linear import linear
from megastep.agents.networks.masked_moments import masked_moments
from megastep.agents.networks.precision import compute_dtype
from megastep.agents.networks.running_norm import RESOLUTION, mix_moments, store_if
from megastep.agents.types import Moments
from megastep.kernels.build.launch import Blocks, launch
from megastep.types import Space, Tree

#: Rows that a block of the heads' kernels adds up, and its threads.
STRIP, STRIP_THREADS = LIBRARY.constants["STRIP"], LIBRARY.constants["STRIP_THREADS"]
#: Of which widths are multiples where a kernel computes values.
MULTIPLE = 8
_THREADS = LIBRARY.constants["MASKED_THREADS"]
#: Smallest weight of a rollout's returns in their statistics.
_MIN_RATE = 0.05
#: Smallest standard deviation, far below that of returns in any units, and not 0.
_MIN_SCALE = 1e-15


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

    Args:
        width: number of features.
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

    def update_stats(self, targets: torch.Tensor, valid: torch.Tensor) -> None:
        """Adds returns to the statistics, those of all ranks together; see `add`.

        Args:
            targets: (...,), returns.
            valid: (...,) bool.
        """
        (moments,) = pool_moments(*masked_moments(valid, targets))
        self.add(moments)

    @torch.no_grad()
    @fused(_add_on_gpu, lambda self, *_: is_plain_on_gpu(self.mean, *self.linear.parameters()))
    def add(self, moments: Moments, is_counted: torch.Tensor | None = None) -> None:
        """Adds moments of returns to the statistics, the n-th call with weight max(0.05, 1/n).

        Changes nothing if there is no return, if mean or variance is not finite, or if all returns
        have been 0, which tells nothing about their size.

        Args:
            moments: number of returns, their mean and variance.
            is_counted: () bool; if false, nothing changes. None: true.
        """
        n_valid, mean, variance = moments
        count = self.count + 1
        rate = (1 / count).clamp(min=_MIN_RATE, max=1.0)
        mean, scale = mix_moments(self, mean, variance, rate)
        is_nothing = (self.count == 0) & (scale == 0) & (mean == 0)
        scale = torch.maximum(scale, (RESOLUTION * mean.abs()).clamp(min=_MIN_SCALE))
        weight = self.linear.weight * (self.scale / scale)
        bias = (self.linear.bias * self.scale + (self.mean - mean)) / scale
        is_stored = (n_valid > 0) & (mean + scale).isfinite() & ~is_nothing
        if is_counted is not None:
            is_stored = is_stored & is_counted
        old = self.linear.weight, self.linear.bias, self.mean, self.scale, self.count
        store_if(is_stored, zip(old, (weight, bias, mean, scale, count), strict=True))


class HeadSizes(NamedTuple):
    """The columns of the product of an update's heads, see `joint_heads`. Values alone have only
    those of the critic's hidden layer.
    """

    n_predicted: int = 0  # F
    n_agents: int = 0
    n_choices: int = 0
    width: int = 0

    @property
    def first_score(self) -> int:
        """Index of the first column of scores."""
        return _padded(self.n_predicted)

    @property
    def first_hidden(self) -> int:
        """Index of the first column of the critic's hidden layer."""
        return self.first_score + _padded(self.n_agents * self.n_choices)


def launch_heads(
    product: torch.Tensor, value: dict[str, torch.Tensor], sizes: HeadSizes, **fields
) -> None:
    """Computes what follows from a product (N, columns) bfloat16.

    Args:
        value: of `value_parameters`.
        fields: `values` (N,) float32 to write, and others of the kernel.
    """
    names = "target", "actions", "logprobs", "entropies", "errors"
    launch(
        *(LIBRARY, "heads_forward", product.device),
        Blocks(-(-len(product) // STRIP), threads=STRIP_THREADS),
        **{**dict.fromkeys(names), **fields, **value},
        **dict(product=product, n_rows=len(product), **sizes._asdict()),
    )


def value_parameters(output: ValueOutput) -> dict[str, torch.Tensor]:
    """Returns weight (1, W), bias (1,), scale () and mean () of a critic's output layer."""
    weight, bias = (leaf.detach() for leaf in output.linear.parameters())
    statistics = dict(value_scale=output.scale, value_mean=output.mean)
    return dict(value_weight=aligned(weight), value_bias=bias, **statistics)


def are_few_words(x: torch.Tensor) -> bool:
    """Returns whether the heads' kernels take so many rows (..., W) of such a width."""
    n_rows = x.numel() // max(x.shape[-1], 1)
    return 0 < n_rows <= 2**31 - STRIP and not x.shape[-1] % MULTIPLE


def _value_on_gpu(critic, joined) -> torch.Tensor:
    hidden = linear(joined, critic.hidden)
    rows = aligned(hidden.flatten(0, -2))
    values = rows.new_empty(len(rows), dtype=torch.float32)
    sizes = HeadSizes(width=rows.shape[1])
    launch_heads(rows, value_parameters(critic.output), sizes, values=values)
    return values.view(hidden.shape[:-1])


def _fits_value(critic, joined) -> bool:
    weight, features = critic.output.linear.weight, joined[0]
    is_bf16 = features.is_cuda and compute_dtype(weight) == torch.bfloat16
    is_known = is_bf16 and weight.dtype == torch.float32 and not torch.is_grad_enabled()
    return is_known and are_few_words(features)


@fused(_value_on_gpu, _fits_value)
def asymmetric_value(critic: "Critic", joined: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """Returns the value (...,) from features and projected privileged observations, (..., W)."""
    return critic.output(linear(joined, critic.hidden, torch.relu))


class Critic(nn.Module):
    """Predicts the return: features (..., width) -> (...,) float32, in units of reward.

    With a `privileged_space` the critic is asymmetric (Pinto et al. 2018): it encodes the
    privileged observation into `width` more features, and a hidden layer joins both. The actor
    never sees them.

    Args:
        width: number of features.
        privileged_space: space of what only the critic sees, or None.
    """

    def __init__(self, width: int, privileged_space: Space | None = None):
        super().__init__()
        self.is_asymmetric = privileged_space is not None
        if self.is_asymmetric:
            self.intake = ConcatIntake(privileged_space, width)
            self.hidden = nn.Linear(2 * width, width)
            nn.init.orthogonal_(self.hidden.weight, gain=2**0.5)
            nn.init.zeros_(self.hidden.bias)
        self.output = ValueOutput(width)

    def forward(
        self,
        features: torch.Tensor,
        privileged: Tree | None = None,
        lanes: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Returns the value.

        Args:
            features: (..., width).
            privileged: (..., *shape) or a dict of them; unused by a plain critic.
            lanes: (M,) int64, lanes to select from privileged observations (T, B, ...). None: all.
        """
        encoded = self.encode(privileged, lanes) if self.is_asymmetric else None
        return self.from_encoded(features, encoded)

    def encode(self, privileged: Tree, lanes: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the privileged observations, normalised and encoded, of an asymmetric critic."""
        return self.intake.encode(privileged, lanes)

    def from_encoded(
        self, features: torch.Tensor, encoded: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Returns the value from features (..., width) and what `encode` returned."""
        if not self.is_asymmetric:
            return self.output(features)
        assert encoded is not None
        joined = features, self.intake.projected(encoded)
        return asymmetric_value(self, joined)


def _padded(n) -> int:
    return n + -n % MULTIPLE
