"""The critic: the expected return, from the actor's features and from what only the critic sees.

Axes: `...` any leading axes, such as (B,) lanes or (T, B) time and lanes.
"""

from typing import Any

import torch
from torch import nn

from megastep.agents.networks import heads
from megastep.agents.networks.value_output import ValueOutput


class Critic(nn.Module):
    """The expected return, (..., width) features -> (...,) float32, in units of reward.

    Where `privileged_space` is given the critic is asymmetric (Pinto et al. 2018): it also takes
    values of that space, encoded into `width` more features, and a hidden layer joins the two. The
    actor sees neither, so that a policy acts without them.
    """

    def __init__(self, width: int, privileged_space: Any = None):
        super().__init__()
        self.is_asymmetric = privileged_space is not None
        if self.is_asymmetric:
            self.intake = heads.intake(privileged_space, width)
            self.hidden = nn.Linear(2 * width, width)
            nn.init.orthogonal_(self.hidden.weight, gain=2**0.5)
            nn.init.zeros_(self.hidden.bias)
        self.output = ValueOutput(width)

    def forward(self, features: torch.Tensor, privileged: Any = None) -> torch.Tensor:
        """`privileged` is a value (..., *shape) of its space, or a dict of them."""
        if self.is_asymmetric:
            joined = torch.cat([features, self.intake(privileged).to(features.dtype)], -1)
            features = self.hidden(joined).relu()
        return self.output(features)
