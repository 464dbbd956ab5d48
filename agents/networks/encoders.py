"""Encoders: turn one leaf of an observation into features.

`...` any leading axes, such as (B,) lanes or (T, B) time and lanes; A agents that one lane
controls. An image leaf is (..., A, C, H, W).
"""

import math

import torch
from torch import nn

from megastep import spaces
from megastep.agents.networks.precision import compute_dtype
from megastep.agents.networks.row_convolutions import Conv, Encoder
from megastep.imports import resolve
from megastep.types import Space


class Flat(Encoder):
    """Flattens a vector or an image: (..., *shape) -> (..., n_features)."""

    def __init__(self, space: Space):
        super().__init__()
        self.n_axes = len(space.shape)
        self.n_features = math.prod(space.shape)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return obs.flatten(-self.n_axes)


class OneHot(Encoder):
    """One-hot encoding of integers: (..., A) -> (..., A n)."""

    values: torch.Tensor  # (n,)

    def __init__(self, space: spaces.MultiDiscrete):
        super().__init__()
        self.n_features = space.n_agents * space.n_actions
        self.register_buffer("values", torch.arange(space.n_actions), persistent=False)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return obs[..., None].eq(self.values).flatten(-2)


class Cnn(Encoder):
    """Three convolutions of an image in both directions, (..., A, C, H, W) -> (..., n_features):
    those of Mnih et al. 2015 for images of 36 x 36 pixels and more, of 3 x 3 pixels for smaller
    ones. Agents share weights.
    """

    CHANNELS, MIN_SIDE = (32, 64, 64), 36
    #: (kernel, stride, padding) of each layer
    LARGE, SMALL = ((8, 4, 0), (4, 2, 0), (3, 1, 0)), ((3, 1, 1), (3, 2, 1), (3, 2, 1))

    def __init__(self, space: spaces.MultiImage):
        super().__init__()
        is_large = min(space.H, space.W) >= self.MIN_SIDE
        layers, sizes, n_channels = [], [space.H, space.W], space.C
        for n_out, settings in zip(self.CHANNELS, self.LARGE if is_large else self.SMALL):
            layer = nn.Conv2d(n_channels, n_out, *settings)
            nn.init.orthogonal_(layer.weight, gain=math.sqrt(2))
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
            layers += [layer, nn.ReLU()]
            kernel, stride, padding = settings
            sizes = [(size + 2 * padding - kernel) // stride + 1 for size in sizes]
            n_channels = n_out
        self.layers = nn.Sequential(*layers)
        self.n_features = space.n_agents * n_channels * math.prod(sizes)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        images = obs.flatten(0, -4).to(compute_dtype(next(self.layers.parameters())))
        return self.layers(images).reshape(*obs.shape[:-4], self.n_features)


#: Encoders of images by name. An encoder is a module `Encoder(space)` with `n_features` that maps
#: images (..., A, C, H, W) to features (..., n_features).
ENCODERS = {"linear": Flat, "conv": Conv, "cnn": Cnn}


def make_encoder(space: Space, image_encoder: str, path: str) -> Encoder:
    """Returns the encoder of one leaf of an observation space, whose path messages name. Images
    have one of `ENCODERS`, or one of an import path. ValueError if the space is of an unknown kind,
    there is no such encoder, or its features have the wrong shape.
    """
    if isinstance(space, spaces.MultiImage):
        encoder = resolve(image_encoder, ENCODERS, nn.Module)(space)
        for lead in ((3,), (3, 2)) if ":" in image_encoder else ():
            with torch.no_grad():
                shape = tuple(encoder(torch.zeros(*lead, *space.shape)).shape)
            expected = *lead, getattr(encoder, "n_features", "n_features")
            if shape != expected:
                raise ValueError(
                    f"{image_encoder} breaks the contract of encoders: images "
                    f"{(*lead, *space.shape)} must give features {expected}, not {shape}"
                )
        return encoder
    if isinstance(space, spaces.MultiVector):
        return Flat(space)
    if isinstance(space, spaces.MultiDiscrete):
        return OneHot(space)
    raise ValueError(
        f"no intake is known for the observation space {path or 'itself'} = {space!r}: use "
        "MultiVector, MultiImage, MultiDiscrete or dicts of them"
    )
