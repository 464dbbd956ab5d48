"""The intake: turns an observation into a vector.

`...` any leading axes, such as (B,) lanes or (T, B) time and lanes.
"""

import math

import torch
from torch import nn

from megastep import spaces
from megastep.agents.networks import intake_cpu
from megastep.agents.networks.encoders import Flat, make_encoder
from megastep.agents.networks.layers import linear, normalised
from megastep.agents.networks.precision import compute_dtype
from megastep.agents.networks.running_norm import RunningNorm
from megastep.types import Space, Tree

#: Activations of hidden layers by name.
ACTIVATIONS = {"relu": torch.relu, "tanh": torch.tanh}


class ConcatIntake(nn.Module):
    """Normalises and encodes every leaf of an observation, concatenates the features, and projects
    them to (..., width) with an activation.

    Initially every leaf has the same weight, however many numbers it has: weights have variance
    2 / (leaves x features of the leaf), which preserves the size of the inputs (He et al. 2015).

    Args:
        space: observation space, a leaf or nested dicts.
        width: number of output features.
        encoder: encoder of images, a name in `encoders.ENCODERS` or an import path.
        activation: a name in `ACTIVATIONS`.

    Attributes:
        n_features: features of all leaves together, before the projection.

    Raises:
        ValueError: if a space is of an unknown kind, or nothing is observed.
    """

    def __init__(self, space: Space, width: int, encoder: str = "linear", activation: str = "relu"):
        super().__init__()
        leaves = {
            path: leaf
            for path, leaf in spaces.leaves(space).items()
            if not isinstance(leaf, spaces.MultiEmpty)
        }
        if not leaves:
            raise ValueError(f"the observation space {space!r} has nothing in it to encode")
        self.activation = ACTIVATIONS[activation]
        self.paths = list(leaves)
        self.encoders = nn.ModuleList(
            make_encoder(leaf, encoder, path) for path, leaf in leaves.items()
        )
        self.norms = nn.ModuleList(
            nn.Identity() if isinstance(leaf, spaces.MultiDiscrete) else RunningNorm(leaf)
            for leaf in leaves.values()
        )
        #: whether every leaf is a normalised vector
        self.is_flat = all(isinstance(encoder, Flat) for encoder in self.encoders)
        sizes = [encoder.n_features for encoder in self.encoders]
        self.n_features = sum(sizes)
        # GPUs multiply matrices whose columns are a multiple of 8 several times faster
        self.n_padding = -self.n_features % 8
        self.project = nn.Linear(self.n_features + self.n_padding, width)
        with torch.no_grad():
            self.project.bias.zero_()
            blocks = self.project.weight.split([*sizes, self.n_padding], dim=1)
            blocks[-1].zero_()
            for block, size in zip(blocks, sizes):
                block.normal_(std=math.sqrt(2 / (len(sizes) * size)))

    def forward(self, obs: Tree, lanes: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the projected features (..., width).

        Args:
            obs: (..., *shape) per leaf.
            lanes: (M,) int64, lanes to select from leaves (T, B, ...). None: all.
        """
        return self.projected(self.encode(obs, lanes))

    def projected(self, encoded: torch.Tensor) -> torch.Tensor:
        """Returns the features (..., width) of what `encode` returned."""
        return linear(encoded, self.project, self.activation)

    def encode(self, obs: Tree, lanes: torch.Tensor | None = None) -> torch.Tensor:
        """Returns all leaves, normalised, encoded and concatenated, with columns of zeros at the
        end: (..., n_features + n_padding).
        """
        leaves = self._leaves(obs)
        if self.is_flat:
            n_columns = self.n_features + self.n_padding
            features = normalised(leaves, self.norms, n_columns, lanes)
            if features is not None:
                return features
        if lanes is not None:
            leaves = [leaf.index_select(1, lanes) for leaf in leaves]
        dtype = compute_dtype(self.project.weight)
        if dtype == torch.float32 and intake_cpu.fits(leaves, self.norms, self.encoders):
            return intake_cpu.normalised(leaves, self.norms, self.n_padding)
        features = [
            encoder(norm(leaf)).to(dtype)
            for leaf, norm, encoder in zip(leaves, self.norms, self.encoders, strict=True)
        ]
        if self.n_padding:
            features.append(features[0].new_zeros((*features[0].shape[:-1], self.n_padding)))
        return torch.cat(features, dim=-1)

    def normalised_leaves(self, obs: Tree) -> list[tuple[RunningNorm, torch.Tensor]]:
        """Returns each normalisation with its leaf, for `update_norms`."""
        pairs = zip(self.norms, self._leaves(obs), strict=True)
        return [(norm, leaf) for norm, leaf in pairs if isinstance(norm, RunningNorm)]

    def _leaves(self, obs):
        values = spaces.leaves(obs)
        return [values[path] for path in self.paths]
