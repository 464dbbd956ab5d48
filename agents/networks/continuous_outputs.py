"""Outputs of continuous actions within bounds: a squashed Gaussian, or a Beta distribution.

`...` any leading axes; A agents that one lane controls, D independent numbers of each.
Probabilities and entropy are of x, the action scaled to -1 to 1: whatever the bounds, a uniform
distribution has an entropy of log 2 per number.
"""

import math

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from megastep import spaces
from megastep.agents.generator import draw
from megastep.agents.networks.heads import Output
from megastep.agents.networks.linear import linear

# Actions closer to a bound count as this far from it: atanh would be infinite.
_MAX_X = 1 - 2**-20
_N_NODES = 16


class _BoundedOutput(Output):
    """Base: a linear layer that starts near 0, with `n_parameters` per number.

    Logits are (..., A, 2 D), actions (..., A, D) float32 within the bounds. `logprob` and `entropy`
    (...,) belong to the lane's joint action: they are summed over agents and numbers.
    """

    low: torch.Tensor  # (D,)
    high: torch.Tensor

    def __init__(self, space: spaces.MultiContinuous, width: int, n_parameters: int):
        super().__init__()
        self.shape = space.shape
        low, high = space.tensors()
        for name, bound in dict(low=low, high=high).items():
            self.register_buffer(name, bound, persistent=False)
        self.linear = nn.Linear(width, n_parameters * math.prod(self.shape))
        nn.init.orthogonal_(self.linear.weight, gain=0.01)
        nn.init.zeros_(self.linear.bias)

    def _linear(self, x) -> torch.Tensor:
        return linear(x, self.linear).float().unflatten(-1, (self.shape[0], -1))

    def _scaled(self, actions) -> torch.Tensor:
        x = 2 * (actions.float() - self.low) / (self.high - self.low) - 1
        return x.clamp(-_MAX_X, _MAX_X)

    def _actions(self, x) -> torch.Tensor:
        actions = self.low + (self.high - self.low) * (x + 1) / 2
        return actions.clamp(self.low, self.high)


class GaussianOutput(_BoundedOutput):
    """The tanh of a Gaussian per number (Haarnoja et al. 2018, appendix C). Its standard deviation
    is learned and the same in every state. Logits are means, then logarithms of standard
    deviations, before the tanh.
    """

    # tanh(5) is 0.9999, and the gradient of a log-probability is inverse to the standard deviation
    max_mean = 5.0
    min_log_std = -3.0
    nodes: torch.Tensor  # of the quadrature
    weights: torch.Tensor

    def __init__(self, space: spaces.MultiContinuous, width: int):
        super().__init__(space, width, n_parameters=1)
        self.log_std = nn.Parameter(torch.zeros(self.shape))
        nodes, areas = np.polynomial.hermite_e.hermegauss(_N_NODES)
        for name, numbers in dict(nodes=nodes, weights=areas / areas.sum()).items():
            self.register_buffer(name, torch.tensor(numbers).float(), persistent=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        mean = self.max_mean * (self._linear(x) / self.max_mean).tanh()
        log_std = self.min_log_std + F.softplus(self.log_std - self.min_log_std)
        return torch.cat([mean, log_std.expand_as(mean)], -1)

    def sample(
        self, logits: torch.Tensor, generator: torch.Generator | None = None
    ) -> torch.Tensor:
        """Samples actions."""
        mean, log_std = logits.chunk(2, -1)
        noise = draw(self, torch.Tensor.normal_, mean.shape, generator, mean.device)
        return self._actions((mean + log_std.exp() * noise).tanh())

    def greedy(self, logits: torch.Tensor) -> torch.Tensor:
        """Returns the median actions."""
        return self._actions(logits.chunk(2, -1)[0].tanh())

    def logprob(self, logits: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Returns the log-probability density (...,) of actions."""
        mean, log_std = logits.chunk(2, -1)
        u = self._scaled(actions).atanh()
        gaussian = -0.5 * (((u - mean) / log_std.exp()).square() + math.log(2 * math.pi)) - log_std
        return (gaussian - _log_slope(u)).sum((-1, -2))

    def entropy(self, logits: torch.Tensor) -> torch.Tensor:
        """Returns the differential entropy (...,) in nats, by Gauss-Hermite quadrature."""
        mean, log_std = logits.chunk(2, -1)
        u = mean[..., None] + log_std.exp()[..., None] * self.nodes
        gaussian = log_std + 0.5 * math.log(2 * math.pi * math.e)
        return (gaussian + (_log_slope(u) * self.weights).sum(-1)).sum((-1, -2))


class BetaOutput(_BoundedOutput):
    """A Beta distribution per number (Chou et al. 2017). Its mean and its spread depend on the
    state. Both parameters exceed 1, so that it has a single mode. Logits are alphas, then betas.
    """

    def __init__(self, space: spaces.MultiContinuous, width: int):
        super().__init__(space, width, n_parameters=2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return 1 + F.softplus(self._linear(x))

    def sample(
        self, logits: torch.Tensor, generator: torch.Generator | None = None
    ) -> torch.Tensor:
        """Samples actions."""
        alpha, beta = torch._standard_gamma(logits, generator).chunk(2, -1)  # pyright: ignore[reportPrivateImportUsage]
        return self._actions(2 * alpha / (alpha + beta) - 1)

    def greedy(self, logits: torch.Tensor) -> torch.Tensor:
        """Returns the mean actions."""
        alpha, beta = logits.chunk(2, -1)
        return self._actions(2 * alpha / (alpha + beta) - 1)

    def logprob(self, logits: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Returns the log-probability density (...,) of actions."""
        alpha, beta = logits.chunk(2, -1)
        x = self._scaled(actions)
        density = (alpha - 1) * ((1 + x) / 2).log() + (beta - 1) * ((1 - x) / 2).log()
        return (density - _log_beta(alpha, beta) - math.log(2)).sum((-1, -2))

    def entropy(self, logits: torch.Tensor) -> torch.Tensor:
        """Returns the differential entropy (...,) in nats."""
        alpha, beta = logits.chunk(2, -1)
        entropy = (
            _log_beta(alpha, beta)
            - (alpha - 1) * alpha.digamma()
            - (beta - 1) * beta.digamma()
            + (alpha + beta - 2) * (alpha + beta).digamma()
        )
        return (entropy + math.log(2)).sum((-1, -2))


def _log_slope(u) -> torch.Tensor:
    """Returns log(1 - tanh(u)^2), the logarithm of the slope of tanh, without cancellation."""
    return 2 * (math.log(2) - u - F.softplus(-2 * u))


def _log_beta(alpha, beta) -> torch.Tensor:
    return alpha.lgamma() + beta.lgamma() - (alpha + beta).lgamma()
