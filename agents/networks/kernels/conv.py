"""The encoder `Conv` on a GPU whose tensor cores take bfloat16 and that copies in bulk (Hopper and
later): both convolutions and their ReLUs in one kernel, and all their gradients in another.

N rows of C channels and W columns; W' columns of features. All tensors are bfloat16, on one GPU.
"""

from pathlib import Path

import torch

from megastep.agents.networks.kernels.layers import sum_rows
from megastep.agents.networks.kernels.library import aligned, aligned_rows
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

# Lambdas with type parameters are device code only if everything is.
_FLAGS = *FAST_CUDA_FLAGS, "--device-as-default-execution-space"
LIBRARY = KernelLibrary(Path(__file__).parent / "convolutions", _FLAGS)
MAX_CHANNELS = LIBRARY.constants["CONV_INPUTS"]
CHANNELS = LIBRARY.constants["CONV_CHANNELS"]
_ROWS, _THREADS, _BLOCKS = (
    LIBRARY.constants[f"CONV_{name}"] for name in "ROWS THREADS BLOCKS".split()
)
ALIGNMENT = 8  # numbers in 16 bytes
_BARRIER = 16  # bytes of shared memory that count copies
_RESERVED = 1024  # bytes of shared memory that each block takes besides its own


def n_outputs(n_columns: int) -> int:
    """Returns W' of rows of W columns."""
    n_hidden = n_columns // 4 + 1
    return n_hidden // 2 + 1


def is_supported(rows: torch.Tensor) -> bool:
    """Returns whether the kernels take rows (N, C, W) of this dtype on their device. The backward
    one needs more memory.
    """
    _, n_channels, n_columns = rows.shape
    if not rows.is_cuda or rows.dtype != torch.bfloat16 or n_channels > MAX_CHANNELS:
        return False
    gpu = torch.cuda.get_device_properties(rows.device)
    _, n_bytes = _backward_sizes(n_channels, n_columns)
    return gpu.major >= 9 and gpu.shared_memory_per_block_optin >= n_bytes


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
        features = rows.new_empty(n_rows, CHANNELS * n_outputs(n_columns))
    weights = dict(
        first_weight=first_weight,
        first_bias=first_bias,
        second_weight=second_weight,
        second_bias=second_bias,
    )
    gpu = torch.cuda.get_device_properties(rows.device)
    n_blocks = min(-(-n_rows // _ROWS), _BLOCKS * gpu.multi_processor_count)
    kernel, blocks, sizes = forward_kernel(n_channels, n_columns, n_blocks)
    launch(
        *(LIBRARY, kernel, rows.device, blocks),
        rows=rows,
        **{name: aligned(weight) for name, weight in weights.items()},
        features=features,
        n_rows=n_rows,
        n_channels=n_channels,
        n_columns=n_columns,
        row_stride=rows.stride(0),
        feature_stride=features.stride(0),
        **sizes,
    )
    return features


def forward_kernel(
    n_channels: int, n_columns: int, n_blocks: int
) -> tuple[str, Blocks, dict[str, int]]:
    """Returns the kernel of `conv_forward`, its blocks and the fields of its struct that are sizes
    in shared memory.

    Args:
        n_channels: C.
        n_columns: W.
        n_blocks: how many.
    """
    sizes = _forward_sizes(n_channels, n_columns)
    blocks = Blocks(n_blocks, threads=_THREADS, shared=_forward_bytes(**sizes))
    return f"conv_forward_{4 if n_channels <= 4 else 8}", blocks, sizes


def _forward_sizes(n_channels, n_columns) -> dict[str, int]:
    """Returns sizes in shared memory, in numbers.

    Threads of eight channels and rows read 16 bytes at once, from different banks: a channel takes
    an odd number of 16 bytes, a row 4 more than a multiple of 8 of them. They write features by
    rows of an odd number.
    """
    words = n_outputs(n_columns) | 1
    row_words = n_channels * words
    row_words += (4 - row_words) % 8
    feature_words = CHANNELS * n_outputs(n_columns) // ALIGNMENT | 1
    sizes = dict(channel_size=words, row_size=row_words, feature_size=feature_words)
    return {name: ALIGNMENT * size for name, size in sizes.items()}


def _forward_bytes(channel_size, row_size, feature_size) -> int:
    return 2 * _ROWS * (2 * row_size + feature_size)


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
    sizes = [first_weight.numel(), CHANNELS, second_weight.numel(), CHANNELS]
    gpu = torch.cuda.get_device_properties(rows.device)
    n_blocks = _backward_blocks(n_rows, n_channels, n_columns, gpu)
    sums = rows.new_empty(n_blocks, sum(sizes), dtype=torch.float32)
    kernel, blocks, shared_sizes = backward_kernel(n_channels, n_columns, n_blocks)
    launch(
        *(LIBRARY, kernel, rows.device, blocks),
        d_features=d_features,
        features=features,
        rows=rows,
        first_weight=aligned(first_weight),
        first_bias=first_bias.contiguous(),
        second_weight=aligned(second_weight),
        sums=sums,
        n_rows=n_rows,
        n_channels=n_channels,
        n_columns=n_columns,
        d_stride=d_features.stride(0),
        feature_stride=features.stride(0),
        row_stride=rows.stride(0),
        **shared_sizes,
    )
    parts = sum_rows(sums).split(sizes)
    return parts[0].view_as(first_weight), parts[1], parts[2].view_as(second_weight), parts[3]


def backward_kernel(
    n_channels: int, n_columns: int, n_blocks: int
) -> tuple[str, Blocks, dict[str, int]]:
    """Returns the kernel of `conv_backward`, as `forward_kernel` does."""
    sizes, n_bytes = _backward_sizes(n_channels, n_columns)
    blocks = Blocks(n_blocks, threads=_THREADS, shared=n_bytes)
    return f"conv_backward_{-(-n_channels // 2) * 2}", blocks, sizes


def _backward_blocks(n_rows, n_channels, n_columns, gpu) -> int:
    """Returns how many blocks run at once, at most one for each tile of rows."""
    _, n_bytes = _backward_sizes(n_channels, n_columns)
    n_at_once = min(_BLOCKS, gpu.shared_memory_per_multiprocessor // (n_bytes + _RESERVED))
    return max(min(-(-n_rows // _ROWS), n_at_once * gpu.multi_processor_count), 1)


def _backward_sizes(n_channels, n_columns) -> tuple[dict[str, int], int]:
    """Returns sizes in shared memory, in numbers, and its bytes.

    Rows start in other banks than those that a warp reads with them: those of features an odd
    multiple of 32 bytes apart, those of images an odd multiple of 16.
    """
    n_features, n_pairs = CHANNELS * n_outputs(n_columns), -(-n_channels // 2)
    staged_size = n_features + 2 * ALIGNMENT
    image_size = ALIGNMENT * (n_pairs * (n_columns // 4 + 2) | 1)
    # per row: two arrays of features, the gradients, and the images of two tiles
    row = 2 * staged_size + n_features + 2 * image_size
    tile = 2 * (_ROWS * row + n_features)
    sums = 4 * 64 * (76 + 8 * n_pairs)  # of two warps, at the end
    return dict(staged_size=staged_size, image_size=image_size), _BARRIER + max(tile, sums)
