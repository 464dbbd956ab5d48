"""Encoders: what turns one leaf of an observation into features.

Axes: `...` any leading axes, such as (B,) lanes or (T, B) time and lanes; A the agents that one
lane controls.
"""

import math
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from megastep import spaces
from megastep.agents.imports import resolve
from megastep.agents.networks.precision import compute_dtype


class Flat(nn.Module):
    """A vector or an image as it is, unrolled: (..., *shape) -> (..., n_features)."""

    def __init__(self, space):
        super().__init__()
        self.axes = len(space.shape)
        self.n_features = math.prod(space.shape)

    def forward(self, obs):
        return obs.flatten(-self.axes)


class OneHot(nn.Module):
    """Integers as indicators: (..., A) -> (..., A n)."""

    def __init__(self, space):
        super().__init__()
        self.n_features = space.n_agents * space.n_actions
        self.register_buffer("values", torch.arange(space.n_actions), persistent=False)

    def forward(self, obs):
        return (obs[..., None] == self.values).flatten(-2)


class BandedConv1d(nn.Conv1d):
    """A convolution of rows of one length, (N, C, W) -> (N, C', W').

    On a GPU, rows of at most `MAX_BANDED` columns are multiplied by a banded matrix, the weights of
    all columns: many times the arithmetic, and several times sooner done, as tensor cores have it
    to spare, and cuDNN's gradients for few channels are slow.
    """

    MAX_BANDED = 256

    def __init__(self, channels, n_columns, out_channels, kernel_size, stride, padding):
        super().__init__(channels, out_channels, kernel_size, stride=stride, padding=padding)
        self.columns = (n_columns + 2 * padding - kernel_size) // stride + 1
        column = torch.arange(n_columns) - stride * torch.arange(self.columns)[:, None] + padding
        # (K, W', W): whether the weight of that place in the kernel joins the two columns
        band = (column == torch.arange(kernel_size)[:, None, None]).float()
        self.register_buffer("band", band, persistent=False)

    def matrix(self) -> torch.Tensor:
        """(C' W', C W) float32: the convolution of a flattened row, but for the bias."""
        with torch.autocast(self.weight.device.type, enabled=False):
            spread = self.weight.flatten(0, 1) @ self.band.flatten(1)
        spread = spread.view(*self.weight.shape[:2], *self.band.shape[1:])
        return spread.transpose(1, 2).flatten(2).flatten(0, 1)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        if rows.is_cuda and self.band.shape[-1] <= self.MAX_BANDED:
            return self.as_product(rows)
        return super().forward(rows)

    def as_product(self, rows: torch.Tensor) -> torch.Tensor:
        """What `forward` gives, by the banded matrix."""
        bias = self.bias[:, None].expand(-1, self.columns).flatten()
        return F.linear(rows.flatten(1), self.matrix(), bias).unflatten(1, (-1, self.columns))


class Conv(nn.Module):
    """An image through two convolutions along its rows: (..., A, C, H, W) -> (..., n_features).

    The image's rows count as channels, since images here are one pixel high or a few. Agents share
    the weights.
    """

    def __init__(self, space, channels=32):
        super().__init__()
        shape = space.C * space.H, space.W
        self.first = BandedConv1d(*shape, channels, kernel_size=8, stride=4, padding=4)
        shape = channels, self.first.columns
        self.second = BandedConv1d(*shape, channels, kernel_size=4, stride=2, padding=2)
        self.n_features = space.n_agents * channels * self.second.columns

    def forward(self, obs):
        lead = obs.shape[:-4]
        rows = obs.reshape(-1, obs.shape[-3] * obs.shape[-2], obs.shape[-1]).to(
            compute_dtype(self.first.weight)
        )
        return F.relu(self.second(F.relu(self.first(rows)))).reshape(*lead, self.n_features)


#: Encoders of images, by name. One is a module `Encoder(space)` with `n_features`, which takes
#: images (..., A, C, H, W) to features (..., n_features).
ENCODERS = {"linear": Flat, "conv": Conv}


def encoder(name: str, space: spaces.MultiImage) -> nn.Module:
    """The encoder of images called `name`: one of `ENCODERS`, or an import path. ValueError if its
    features are not as it says.
    """
    made = resolve(name, ENCODERS)(space)
    if ":" in name:
        _check_encoder(name, made, space)
    return made


@torch.no_grad()
def _check_encoder(name, made, space):
    for lead in (3,), (3, 2):
        got = tuple(made(torch.zeros(*lead, *space.shape)).shape)
        wanted = *lead, getattr(made, "n_features", "n_features")
        if got != wanted:
            raise ValueError(
                f"{name} breaks the contract of encoders: images {(*lead, *space.shape)} give "
                f"features {wanted}, not {got}"
            )


def encoder_of(space: Any, of_images: str, path: str) -> nn.Module:
    """The encoder of a leaf of an observation space; `of_images` is that of images, by name, `path`
    where the leaf is. ValueError if the space is of no known kind.
    """
    if isinstance(space, spaces.MultiImage):
        return encoder(of_images, space)
    if isinstance(space, spaces.MultiVector):
        return Flat(space)
    if isinstance(space, spaces.MultiDiscrete):
        return OneHot(space)
    raise ValueError(
        f"no intake is known for the observation space {path or 'itself'} = {space!r}; "
        "there are MultiVector, MultiImage, MultiDiscrete and dicts of them"
    )
