"""The encoders of images by convolutions: `Cnn`, and `Conv` for images of one or a few rows.

`Conv` on a GPU whose tensor cores take bfloat16 and that copies in bulk (Hopper and later):
both convolutions and their ReLUs are one kernel, and all their gradients another.

N rows of C channels and W columns; W' columns of features; `...` any leading axes, A agents that
one lane controls.
"""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep import spaces
from megastep.agents.networks.fused import aligned, aligned_rows, fused, has_hopper
from megastep.agents.networks.linear import cast as cast_weight
from megastep.agents.networks.linear import compute_dtype, sum_rows
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

# Lambdas with type parameters are device code only if everything is.
_FLAGS = *FAST_CUDA_FLAGS, "--device-as-default-execution-space"
LIBRARY = KernelLibrary(Path(__file__).parent / "kernels" / "convolutions", _FLAGS)
_MAX_CHANNELS, MAX_COLUMNS = LIBRARY.constants["CONV_INPUTS"], 256
_CHANNELS, _ROWS, _THREADS, _BLOCKS = (
    LIBRARY.constants[f"CONV_{name}"] for name in "CHANNELS ROWS THREADS BLOCKS".split()
)
_ALIGNMENT = 8  # numbers in 16 bytes
_BARRIER = 16  # bytes of shared memory that count copies
_RESERVED = 1024  # bytes of shared memory that each block takes besides its own


class Cnn(nn.Module):
    """Three convolutions of an image in both directions, (..., A, C, H, W) -> (..., n_features):
    those of Mnih et al. 2015 for images of 36 x 36 pixels and more, of 3 x 3 pixels for smaller
    ones. Agents share weights.
    """

    takes_parts = True
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


class Conv(nn.Module):
    """Two convolutions along the rows of an image: (..., A, C, H, W) -> (..., n_features).

    The H rows count as channels, since images are one or a few pixels high. Agents share weights.
    """

    takes_parts = True

    def __init__(self, space: spaces.MultiImage):
        super().__init__()
        self.row_shape = space.C * space.H, space.W
        self.first = nn.Conv1d(self.row_shape[0], _CHANNELS, 8, stride=4, padding=4)
        self.second = nn.Conv1d(_CHANNELS, _CHANNELS, 4, stride=2, padding=2)
        self.n_row_features = _CHANNELS * n_outputs(space.W)  # of one agent
        self.n_features = space.n_agents * self.n_row_features

    @staticmethod
    def encode_runs(
        columns: torch.Tensor, runs: Sequence[tuple], encoders: nn.ModuleList
    ) -> torch.Tensor:
        """Returns features (N, n) of an intake's runs of columns (N, n_columns); see `encode`."""
        parts, n_features = [], 0
        for i, shape, start, end in runs:
            encoder = None if i is None else cast("Conv", encoders[i])
            n_images = 1 if encoder is None else shape[0]
            size = (end - start) // n_images
            for source in range(start, end, size):
                target = n_features
                n_features += size if encoder is None else encoder.n_row_features
                parts.append(Part(encoder, slice(source, source + size), slice(target, n_features)))
        return encode(columns, parts)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        rows = obs.reshape(-1, math.prod(self.row_shape)).to(compute_dtype(self.first.weight))
        part = Part(self, slice(0, rows.shape[1]), slice(0, self.n_row_features))
        return encode(rows, [part]).reshape(*obs.shape[:-4], self.n_features)


class Part(NamedTuple):
    """Columns of normalised observations (`source`) that become columns of features (`target`) by
    the encoder of one image. None: they are copied.
    """

    encoder: Conv | None
    source: slice
    target: slice

    def rows(self, columns: torch.Tensor) -> torch.Tensor:
        """Returns the encoder's rows (N, C H, W), a view of (N, n_columns)."""
        assert self.encoder is not None
        return columns[:, self.source].unflatten(1, self.encoder.row_shape)


class _Encode(torch.autograd.Function):
    """Each part's encoder has four parameters, in the order of the parts."""

    @staticmethod
    def forward(ctx, columns, parts, *parameters) -> torch.Tensor:
        features = columns.new_empty(len(columns), parts[-1].target.stop)
        weights = [cast_weight(leaf, columns.dtype) for leaf in parameters]
        of_encoders = iter(weights)
        for part in parts:
            target = features[:, part.target]
            if part.encoder is None:
                target.copy_(columns[:, part.source])
            else:
                conv_forward(part.rows(columns), *itertools.islice(of_encoders, 4), features=target)
        ctx.parts = parts
        ctx.save_for_backward(columns, features, *weights)
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx, d) -> tuple[torch.Tensor | None, ...]:
        columns, features, *weights = ctx.saved_tensors
        of_encoders, gradients = iter(weights), [None, None]
        for part in filter(lambda part: part.encoder, ctx.parts):
            *of_part, _ = itertools.islice(of_encoders, 4)
            is_needed = ctx.needs_input_grad[len(gradients) : len(gradients) + 4]
            found = [None] * 4
            if any(is_needed):
                of_features = d[:, part.target], features[:, part.target]
                found = conv_backward(*of_features, part.rows(columns), *of_part)
            gradients += [one if needed else None for one, needed in zip(found, is_needed)]
        return tuple(gradients)


def _can_encode(columns, parts) -> bool:
    if columns.requires_grad or parts[-1].target.stop % _ALIGNMENT:
        return False
    images = [part for part in parts if part.encoder]
    return all(p.target.start % _ALIGNMENT == 0 and takes(p.rows(columns)) for p in images)


def _encode_on_gpu(columns, parts) -> torch.Tensor:
    parameters = [leaf for part in parts if part.encoder for leaf in part.encoder.parameters()]
    return _Encode.apply(columns, parts, *parameters)


@fused(_encode_on_gpu, _can_encode)
def encode(columns: torch.Tensor, parts: Sequence[Part]) -> torch.Tensor:
    """Returns features (N, n) of parts, whose targets follow each other, of observations side by
    side (N, n_columns).
    """
    features = []
    for part in parts:
        encoder = part.encoder
        if encoder is None:
            features.append(columns[:, part.source].contiguous())
        else:
            hidden = torch.relu(encoder.first(part.rows(columns)))
            features.append(torch.relu(encoder.second(hidden)).flatten(1))
    return torch.cat(features, 1) if len(features) > 1 else features[0]


# ---- Its kernels ----


def n_outputs(n_columns: int) -> int:
    """Returns W' of rows of W columns."""
    return (n_columns // 4 + 1) // 2 + 1


def takes(rows: torch.Tensor) -> bool:
    """Returns whether the kernels take rows (N, C, W) of this dtype on their device."""
    _, n_channels, n_columns = rows.shape
    is_bf16 = rows.is_cuda and rows.dtype == torch.bfloat16
    if not is_bf16 or n_channels > _MAX_CHANNELS or n_columns > MAX_COLUMNS:
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
    """Convolves rows (N, C, W) for which `takes` twice, with a ReLU after each convolution, into
    features (N, 32 W'), by channel, then by column. Hidden activations and features are float32
    sums, rounded to bfloat16 after bias and ReLU.

    Weights and biases are (32, C, 8), (32,), (32, 32, 4) and (32,). Rows may be columns of a wider
    tensor; so may `features`, if given, at multiples of 16 bytes.
    """
    n_rows, n_channels, n_columns = rows.shape
    if features is None:
        features = rows.new_empty(n_rows, _CHANNELS * n_outputs(n_columns))
    gpu = torch.cuda.get_device_properties(rows.device)
    n_blocks = min(-(-n_rows // _ROWS), _BLOCKS * gpu.multi_processor_count)
    sizes = _forward_sizes(n_channels, n_columns)
    shared = 2 * _ROWS * (2 * sizes["row_size"] + sizes["feature_size"])
    launch(
        *(LIBRARY, f"conv_forward_{4 if n_channels <= 4 else 8}", rows.device),
        Blocks(n_blocks, threads=_THREADS, shared=shared),
        **dict(first_weight=aligned(first_weight), first_bias=aligned(first_bias)),
        **dict(second_weight=aligned(second_weight), second_bias=aligned(second_bias)),
        **dict(features=features, feature_stride=features.stride(0)),
        **_fields_of(rows),
        **sizes,
    )
    return features


def _fields_of(rows) -> dict[str, object]:
    n_rows, n_channels, n_columns = rows.shape
    if rows.stride()[1:] != (n_columns, 1):
        rows = rows.contiguous()
    sizes = dict(n_rows=n_rows, n_channels=n_channels, n_columns=n_columns)
    return dict(rows=rows, row_stride=rows.stride(0), **sizes)


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
    """Returns the gradients of `conv_forward`'s weights and biases, float32 sums in a fixed order.

    Hidden activations are computed again, and rounded to bfloat16 like their gradients. Gradients
    pass where features (N, 32 W') are above 0 or NaN.
    """
    n_rows, n_channels, n_columns = rows.shape
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
        **dict(first_weight=aligned(first_weight), first_bias=first_bias.contiguous()),
        **dict(second_weight=aligned(second_weight), sums=sums),
        **_fields_of(rows),
        **shared_sizes,
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
