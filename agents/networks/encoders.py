"""Encoders: turn one leaf of an observation into features.

`...` any leading axes, such as (B,) lanes or (T, B) time and lanes; A agents that one lane
controls. An image leaf is (..., A, C, H, W).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep import spaces
from megastep.agents.networks.kernels import conv as kernels
from megastep.agents.networks.layers import Activation, affine
from megastep.agents.networks.precision import cast, compute_dtype, once
from megastep.imports import resolve
from megastep.types import Space


class Encoder(nn.Module):
    """Base of the encoders of a leaf, which map (..., *shape) to (..., n_features)."""

    n_features: int


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


class BandedConv1d(nn.Conv1d):
    """A convolution of rows of fixed length, (N, C, W) -> (N, C', W').

    On a GPU, rows of at most `MAX_BANDED` columns are multiplied by a banded matrix that holds the
    weights of every column. That takes many times the arithmetic, but on tensor cores it is several
    times faster than cuDNN, whose gradients are slow for few channels.

    Args:
        in_channels: C.
        n_columns: W.
        out_channels: C'.
        kernel_size: columns of the kernel, K.
        stride: columns between two outputs.
        padding: columns of zeros at each end.
    """

    MAX_BANDED = 256
    band: torch.Tensor  # (K, W', W)
    bias: torch.Tensor  # (C',)

    def __init__(
        self,
        in_channels: int,
        n_columns: int,
        out_channels: int,
        kernel_size: int,
        stride: int,
        padding: int,
    ):
        super().__init__(in_channels, out_channels, kernel_size, stride=stride, padding=padding)
        self.n_columns = n_columns
        self.n_outputs = (n_columns + 2 * padding - kernel_size) // stride + 1
        offset = torch.arange(n_columns) - stride * torch.arange(self.n_outputs)[:, None] + padding
        # (K, W', W): 1 where kernel column k connects input column w to output column w'
        band = (offset == torch.arange(kernel_size)[:, None, None]).float()
        self.register_buffer("band", band, persistent=False)

    def matrix(self) -> torch.Tensor:
        """Returns (C' W', C W) float32, the convolution of a flattened row without the bias."""
        with torch.autocast(self.weight.device.type, enabled=False):
            spread = self.weight.flatten(0, 1) @ self.band.flatten(1)
        spread = spread.view(*self.weight.shape[:2], *self.band.shape[1:])
        return spread.transpose(1, 2).flatten(2).flatten(0, 1)

    def column_bias(self) -> torch.Tensor:
        """Returns (C' W',), the bias of each row of `matrix`."""
        return self.bias[:, None].expand(-1, self.n_outputs).flatten()

    def forward(self, rows: torch.Tensor, activation: Activation | None = None) -> torch.Tensor:
        """Returns the convolution of rows (N, C, W), with an activation: (N, C', W')."""
        if rows.is_cuda and self.band.shape[-1] <= self.MAX_BANDED:
            return self.as_product(rows, activation)
        outputs = super().forward(rows)
        return outputs if activation is None else activation(outputs)

    def as_product(self, rows: torch.Tensor, activation: Activation | None = None) -> torch.Tensor:
        """Does what `forward` does with the banded matrix."""
        if torch.is_grad_enabled():
            matrix, bias = self.matrix(), self.column_bias()
        else:
            matrix = once((self.weight,), "matrix", self.matrix)
            bias = once((self.bias,), "column_bias", self.column_bias)
        outputs = affine(rows.flatten(1), matrix, bias, activation)
        return outputs.unflatten(1, (-1, self.n_outputs))


class Conv(Encoder):
    """Two convolutions along the rows of an image: (..., A, C, H, W) -> (..., n_features).

    The H rows count as channels, since images are one or a few pixels high. Agents share weights.
    In bfloat16 on GPUs from Hopper on, one kernel does both (`encode`).
    """

    def __init__(self, space: spaces.MultiImage, channels: int = 32):
        super().__init__()
        self.row_shape = shape = space.C * space.H, space.W
        self.first = BandedConv1d(*shape, channels, kernel_size=8, stride=4, padding=4)
        shape = channels, self.first.n_outputs
        self.second = BandedConv1d(*shape, channels, kernel_size=4, stride=2, padding=2)
        self.n_row_features = channels * self.second.n_outputs  # of one agent
        self.n_features = space.n_agents * self.n_row_features

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        rows = obs.reshape(-1, *self.row_shape).to(compute_dtype(self.first.weight))
        part = Part(self, slice(0, math.prod(self.row_shape)), slice(0, self.n_row_features))
        columns = rows.flatten(1)
        if can_encode(columns, [part]):
            features = encode(columns, [part])
        else:
            features = self.convolved(rows)
        return features.reshape(*obs.shape[:-4], self.n_features)

    def convolved(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns the features (N, n_row_features) of rows (N, C H, W), layer by layer."""
        return self.second(self.first(rows, torch.relu), torch.relu).flatten(1)

    def parameters_in_order(self) -> tuple[torch.Tensor, ...]:
        """Returns weight and bias of the first, then of the second convolution."""
        return self.first.weight, self.first.bias, self.second.weight, self.second.bias


class Part(NamedTuple):
    """Columns of normalised observations that become columns of features.

    Attributes:
        encoder: of one image. None: the columns are copied.
        source: columns of the observations.
        target: columns of the features.
    """

    encoder: Conv | None
    source: slice
    target: slice

    def rows(self, columns: torch.Tensor) -> torch.Tensor:
        """Returns the encoder's rows (N, C H, W), a view of (N, n_columns)."""
        assert self.encoder is not None
        return columns[:, self.source].unflatten(1, self.encoder.row_shape)

    def is_supported(self, columns: torch.Tensor) -> bool:
        """Returns whether the kernels take the encoder's rows."""
        assert self.encoder is not None
        first = self.encoder.first
        is_size_right = (
            first.out_channels == kernels.CHANNELS
            and first.n_columns <= first.MAX_BANDED
            and self.target.start % kernels.ALIGNMENT == 0
        )
        return is_size_right and kernels.is_supported(self.rows(columns))


def can_encode(columns: torch.Tensor, parts: Sequence[Part]) -> bool:
    """Returns whether `encode` takes these observations: bfloat16, on GPUs with its kernel."""
    if columns.requires_grad or parts[-1].target.stop % kernels.ALIGNMENT:
        return False
    return all(part.encoder is None or part.is_supported(columns) for part in parts)


def encode(columns: torch.Tensor, parts: Sequence[Part]) -> torch.Tensor:
    """Encodes parts of observations side by side, one kernel for each.

    Args:
        columns: (N, n_columns) bfloat16, each row contiguous. Gets no gradient.
        parts: whose targets follow each other.

    Returns:
        features (N, n) bfloat16.
    """
    encoders = [part.encoder for part in parts if part.encoder]
    parameters = [leaf for encoder in encoders for leaf in encoder.parameters_in_order()]
    return _Encode.apply(columns, parts, *parameters)


class _Encode(torch.autograd.Function):
    """What `encode` does. Each part's encoder has four parameters, in the order of the parts."""

    @staticmethod
    def forward(ctx, columns, parts, *parameters) -> torch.Tensor:
        features = columns.new_empty(len(columns), parts[-1].target.stop)
        weights = [cast(leaf, columns.dtype) for leaf in parameters]
        of_encoders = iter(weights)
        for part in parts:
            target = features[:, part.target]
            if part.encoder is None:
                target.copy_(columns[:, part.source])
            else:
                first = next(of_encoders), next(of_encoders)
                second = next(of_encoders), next(of_encoders)
                kernels.conv_forward(part.rows(columns), *first, *second, target)
        ctx.parts = parts
        ctx.save_for_backward(columns, features, *weights)
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx, d) -> tuple[torch.Tensor | None, ...]:
        columns, features, *weights = ctx.saved_tensors
        of_encoders, gradients = iter(weights), [None, None]
        for part in ctx.parts:
            if part.encoder is None:
                continue
            *of_part, _ = (next(of_encoders) for _ in range(4))
            is_needed = ctx.needs_input_grad[len(gradients) : len(gradients) + 4]
            found = [None] * 4
            if any(is_needed):
                of_features = d[:, part.target], features[:, part.target]
                found = kernels.conv_backward(*of_features, part.rows(columns), *of_part)
            gradients += [one if needed else None for one, needed in zip(found, is_needed)]
        return tuple(gradients)


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


def make_image_encoder(name: str, space: spaces.MultiImage) -> Encoder:
    """Returns an encoder of images.

    Args:
        name: a name in `ENCODERS`, or an import path.
        space: space of the images.

    Raises:
        ValueError: if there is no such encoder, or its features have the wrong shape.
    """
    encoder = resolve(name, ENCODERS, nn.Module)(space)
    if ":" in name:
        _check_encoder(name, encoder, space)
    return encoder


@torch.no_grad()
def _check_encoder(name, encoder, space) -> None:
    for lead in (3,), (3, 2):
        shape = tuple(encoder(torch.zeros(*lead, *space.shape)).shape)
        expected = *lead, getattr(encoder, "n_features", "n_features")
        if shape != expected:
            raise ValueError(
                f"{name} breaks the contract of encoders: images {(*lead, *space.shape)} must give "
                f"features {expected}, not {shape}"
            )


def make_encoder(space: Space, image_encoder: str, path: str) -> Encoder:
    """Returns the encoder of one leaf of an observation space.

    Args:
        space: the leaf.
        image_encoder: encoder of images, by name.
        path: dotted path of the leaf, for the message.

    Raises:
        ValueError: if the space is of an unknown kind.
    """
    if isinstance(space, spaces.MultiImage):
        return make_image_encoder(image_encoder, space)
    if isinstance(space, spaces.MultiVector):
        return Flat(space)
    if isinstance(space, spaces.MultiDiscrete):
        return OneHot(space)
    raise ValueError(
        f"no intake is known for the observation space {path or 'itself'} = {space!r}: use "
        "MultiVector, MultiImage, MultiDiscrete or dicts of them"
    )
