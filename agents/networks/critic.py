"""The critic: predicts the return from the actor's features and from privileged observations.

`...` any leading axes, such as (B,) lanes or (T, B) time and lanes.
"""

import torch
from torch import nn

from megastep.agents.networks import heads
from megastep.agents.networks.layers import linear
from megastep.agents.networks.value_output import ValueOutput
from megastep.types import Space, Tree


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
            self.intake = heads.intake(privileged_space, width)
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
        if self.output.is_fused(features):
            return self.output.of_hidden(linear(joined, self.hidden))
        return self.output(linear(joined, self.hidden, torch.relu))
