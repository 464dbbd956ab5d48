"""The encoder `Conv`: convolutions of images of one or a few rows of pixels.

On a GPU whose tensor cores take bfloat16 and that copies in bulk (Hopper and later), both
convolutions and their ReLUs are one kernel, and all their gradients another. On other GPUs each is
a product with a banded matrix.

N rows of C channels and W columns; W' columns of features; `...` any leading axes, A agents that
one lane controls.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep import spaces
from megastep.agents.networks.fused import aligned, aligned_rows, fused, has_hopper
from megastep.agents.networks.linear import Activation, affine, sum_rows
from megastep.agents.networks.precision import cast, compute_dtype, once
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

# Lambdas with type parameters are device code only if everything is.
_FLAGS = *FAST_CUDA_FLAGS, "--device-as-default-execution-space"
LIBRARY = KernelLibrary(Path(__file__).parent / "kernels" / "convolutions", _FLAGS)
_MAX_CHANNELS = LIBRARY.constants["CONV_INPUTS"]
_CHANNELS, _ROWS, _THREADS, _BLOCKS = (
    LIBRARY.constants[f"CONV_{name}"] for name in "CHANNELS ROWS THREADS BLOCKS".split()
)
_ALIGNMENT = 8  # numbers in 16 bytes
_BARRIER = 16  # bytes of shared memory that count copies
_RESERVED = 1024  # bytes of shared memory that each block takes besides its own


class Encoder(nn.Module):
    """Base of the encoders of a leaf, which map (..., *shape) to (..., n_features)."""

    n_features: int


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
    In bfloat16 on GPUs from Hopper on, one kernel does both.
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
        return encode(rows.flatten(1), [part]).reshape(*obs.shape[:-4], self.n_features)

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

    def is_known(self, columns: torch.Tensor) -> bool:
        """Returns whether the kernels take the encoder's rows."""
        assert self.encoder is not None
        first = self.encoder.first
        is_size_right = (
            first.out_channels == _CHANNELS
            and first.n_columns <= first.MAX_BANDED
            and self.target.start % _ALIGNMENT == 0
        )
        return is_size_right and takes(self.rows(columns))


def _can_encode(columns, parts) -> bool:
    if columns.requires_grad or parts[-1].target.stop % _ALIGNMENT:
        return False
    return all(part.encoder is None or part.is_known(columns) for part in parts)


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
                conv_forward(part.rows(columns), *first, *second, target)
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
                found = conv_backward(*of_features, part.rows(columns), *of_part)
            gradients += [one if needed else None for one, needed in zip(found, is_needed)]
        return tuple(gradients)


def _encode_on_gpu(columns, parts) -> torch.Tensor:
    encoders = [part.encoder for part in parts if part.encoder]
    parameters = [leaf for encoder in encoders for leaf in encoder.parameters_in_order()]
    return _Encode.apply(columns, parts, *parameters)


@fused(_encode_on_gpu, _can_encode)
def encode(columns: torch.Tensor, parts: Sequence[Part]) -> torch.Tensor:
    """Returns features (N, n) of parts of observations side by side; in bfloat16 on GPUs with its
    kernels, one for each part.

    Args:
        columns: (N, n_columns), each row contiguous.
        parts: whose targets follow each other.
    """
    features = []
    for part in parts:
        if part.encoder is None:
            features.append(columns[:, part.source].contiguous())
        else:
            features.append(part.encoder.convolved(part.rows(columns)))
    return torch.cat(features, 1) if len(features) > 1 else features[0]


# ---- Its kernels ----


def n_outputs(n_columns: int) -> int:
    """Returns W' of rows of W columns."""
    n_hidden = n_columns // 4 + 1
    return n_hidden // 2 + 1


def takes(rows: torch.Tensor) -> bool:
    """Returns whether the kernels take rows (N, C, W) of this dtype on their device. The backward
    one needs more memory.
    """
    _, n_channels, n_columns = rows.shape
    if not rows.is_cuda or rows.dtype != torch.bfloat16 or n_channels > _MAX_CHANNELS:
        return False
    return has_hopper(rows.device, _backward_sizes(n_channels, n_columns)[1])


def conv_forward(
    rows: torch.Tensor,
    first_weight: torch.Tensor,
    first_bias: torch.Tensor,
    second_weight: torch.Tensor,
    second_bias: torch.Tensor,
    features: torch.Tensor | None = None,
) -> torch.Tensor:
    """Convolves rows twice, with a ReLU after each convolution.

    Hidden activations and features are float32 sums, rounded to bfloat16 after bias and ReLU.

    Args:
        rows: (N, C, W), each row contiguous; may be columns of a wider tensor. Faster if they
            start at multiples of 16 bytes and W is a multiple of 8.
        first_weight: (32, C, 8).
        first_bias: (32,).
        second_weight: (32, 32, 4).
        second_bias: (32,).
        features: (N, 32 W'), where to write; may be columns of a wider tensor, if its rows start at
            multiples of 16 bytes. None: a new tensor.

    Returns:
        features (N, 32 W'), by channel, then by column.
    """
    n_rows, n_channels, n_columns = rows.shape
    if rows.stride()[1:] != (n_columns, 1):
        rows = rows.contiguous()
    if features is None:
        features = rows.new_empty(n_rows, _CHANNELS * n_outputs(n_columns))
    names = "first_weight", "first_bias", "second_weight", "second_bias"
    weights = map(aligned, (first_weight, first_bias, second_weight, second_bias))
    gpu = torch.cuda.get_device_properties(rows.device)
    n_blocks = min(-(-n_rows // _ROWS), _BLOCKS * gpu.multi_processor_count)
    sizes = _forward_sizes(n_channels, n_columns)
    shared = 2 * _ROWS * (2 * sizes["row_size"] + sizes["feature_size"])
    launch(
        *(LIBRARY, f"conv_forward_{4 if n_channels <= 4 else 8}", rows.device),
        Blocks(n_blocks, threads=_THREADS, shared=shared),
        **dict(zip(names, weights, strict=True)),
        **dict(rows=rows, row_stride=rows.stride(0), n_rows=n_rows),
        **dict(features=features, feature_stride=features.stride(0)),
        **dict(n_channels=n_channels, n_columns=n_columns, **sizes),
    )
    return features


def _forward_sizes(n_channels, n_columns) -> dict[str, int]:
    """Returns sizes in shared memory, in numbers.

    Threads of eight channels and rows read 16 bytes at once, from different banks: a channel takes
    an odd number of 16 bytes, a row 4 more than a multiple of 8 of them. They write features by
    rows of an odd number.
    """
    words = n_outputs(n_columns) | 1
    row_words = n_channels * words
    row_words += (4 - row_words) % 8
    feature_words = _CHANNELS * n_outputs(n_columns) // _ALIGNMENT | 1
    sizes = dict(channel_size=words, row_size=row_words, feature_size=feature_words)
    return {name: _ALIGNMENT * size for name, size in sizes.items()}


def conv_backward(
    d_features: torch.Tensor,
    features: torch.Tensor,
    rows: torch.Tensor,
    first_weight: torch.Tensor,
    first_bias: torch.Tensor,
    second_weight: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Computes the gradients of `conv_forward`'s weights and biases.

    Hidden activations are computed again, and rounded to bfloat16 like their gradients. Sums are
    float32 and have a fixed order on a model of GPUs.

    Args:
        d_features: (N, 32 W').
        features: (N, 32 W'), of `conv_forward`. The gradient passes where they are above 0 or NaN.
            Both may be columns of a wider tensor, and are copied if their rows do not start at
            multiples of 16 bytes.
        rows: (N, C, W) for which `is_supported`; may be columns of a wider tensor. Faster if they
            start at multiples of 8 bytes and W is a multiple of 4.
        first_weight: (32, C, 8).
        first_bias: (32,).
        second_weight: (32, 32, 4).

    Returns:
        The gradients of the first weight and bias, then of the second, float32.
    """
    n_rows, n_channels, n_columns = rows.shape
    if rows.stride()[1:] != (n_columns, 1):
        rows = rows.contiguous()
    d_features, features = aligned_rows(d_features), aligned_rows(features)
    sizes = [first_weight.numel(), _CHANNELS, second_weight.numel(), _CHANNELS]
    gpu = torch.cuda.get_device_properties(rows.device)
    shared_sizes, shared = _backward_sizes(n_channels, n_columns)
    # as many as run at once, at most one for each tile of rows
    n_at_once = min(_BLOCKS, gpu.shared_memory_per_multiprocessor // (shared + _RESERVED))
    n_blocks = max(min(-(-n_rows // _ROWS), n_at_once * gpu.multi_processor_count), 1)
    sums = rows.new_empty(n_blocks, sum(sizes), dtype=torch.float32)
    launch(
        *(LIBRARY, f"conv_backward_{-(-n_channels // 2) * 2}", rows.device),
        Blocks(n_blocks, threads=_THREADS, shared=shared),
        **dict(d_features=d_features, d_stride=d_features.stride(0)),
        **dict(features=features, feature_stride=features.stride(0)),
        **dict(rows=rows, row_stride=rows.stride(0), n_rows=n_rows),
        **dict(first_weight=aligned(first_weight), first_bias=first_bias.contiguous()),
        **dict(second_weight=aligned(second_weight), sums=sums),
        **dict(n_channels=n_channels, n_columns=n_columns, **shared_sizes),
    )
    parts = sum_rows(sums).split(sizes)
    return parts[0].view_as(first_weight), parts[1], parts[2].view_as(second_weight), parts[3]


def _backward_sizes(n_channels, n_columns) -> tuple[dict[str, int], int]:
    """Returns sizes in shared memory, in numbers, and its bytes.

    Rows start in other banks than those that a warp reads with them: those of features an odd
    multiple of 32 bytes apart, those of images an odd multiple of 16.
    """
    n_features, n_pairs = _CHANNELS * n_outputs(n_columns), -(-n_channels // 2)
    staged_size = n_features + 2 * _ALIGNMENT
    image_size = _ALIGNMENT * (n_pairs * (n_columns // 4 + 2) | 1)
    # per row: two arrays of features, the gradients, and the images of two tiles
    row = 2 * staged_size + n_features + 2 * image_size
    tile = 2 * (_ROWS * row + n_features)
    sums = 4 * 64 * (76 + 8 * n_pairs)  # of two warps, at the end
    return dict(staged_size=staged_size, image_size=image_size), _BARRIER + max(tile, sums)
