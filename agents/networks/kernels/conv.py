"""The encoder `Conv` on a GPU with tensor cores for bfloat16 and much shared memory (Hopper and
later): both convolutions and their ReLUs in one kernel.

N rows of C channels and W columns; W' columns of features. All tensors are bfloat16, on one GPU.
"""

import torch

from megastep.agents.networks.kernels.lstm_sequence import PROGRAM
from megastep.agents.networks.kernels.program import aligned
from megastep.kernels.build.launch import launch_blocks

MAX_CHANNELS = PROGRAM.constants["CONV_INPUTS"]
CHANNELS = PROGRAM.constants["CONV_CHANNELS"]
_ROWS, _THREADS, _BLOCKS = (
    PROGRAM.constants[f"CONV_{name}"] for name in "ROWS THREADS BLOCKS".split()
)
ALIGNMENT = 8  # numbers in 16 bytes


def n_outputs(n_columns: int) -> int:
    """Returns W' of rows of W columns."""
    n_hidden = n_columns // 4 + 1
    return n_hidden // 2 + 1


def is_supported(rows: torch.Tensor) -> bool:
    """Returns whether the kernel convolves rows (N, C, W) of this dtype on their device."""
    _, n_channels, n_columns = rows.shape
    if not rows.is_cuda or rows.dtype != torch.bfloat16 or n_channels > MAX_CHANNELS:
        return False
    gpu = torch.cuda.get_device_properties(rows.device)
    n_bytes = _shared_bytes(**_shared_sizes(n_channels, n_columns))
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
    sizes = _shared_sizes(n_channels, n_columns)
    shared = _shared_bytes(**sizes)
    weights = dict(
        first_weight=first_weight,
        first_bias=first_bias,
        second_weight=second_weight,
        second_bias=second_bias,
    )
    weights = {name: aligned(weight) for name, weight in weights.items()}
    gpu = torch.cuda.get_device_properties(rows.device)
    n_blocks = min(-(-n_rows // _ROWS), _BLOCKS * gpu.multi_processor_count)
    if n_rows:
        packed = PROGRAM.params.ConvForwardParams(
            rows=rows.data_ptr(),
            **{name: weight.data_ptr() for name, weight in weights.items()},
            features=features.data_ptr(),
            n_rows=n_rows,
            n_channels=n_channels,
            n_columns=n_columns,
            row_stride=rows.stride(0),
            feature_stride=features.stride(0),
            **sizes,
        )
        kernel = f"conv_forward_{4 if n_channels <= 4 else 8}"
        launch_blocks(PROGRAM, kernel, packed, rows.device, (n_blocks, 1), _THREADS, shared)
    return features


def _shared_sizes(n_channels, n_columns):
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


def _shared_bytes(channel_size, row_size, feature_size):
    return 2 * _ROWS * (2 * row_size + feature_size)
