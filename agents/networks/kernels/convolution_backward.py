"""The gradients of the encoder `Conv` on a GPU with tensor cores and enough shared memory (Hopper
and later), in one kernel.

N rows of C channels and W columns; F = 32 features in each of W' columns. All tensors are bfloat16
and on one GPU.
"""

import torch

from megastep.agents.networks.kernels.layers import sum_rows
from megastep.agents.networks.kernels.lstm_sequence import PROGRAM
from megastep.agents.networks.kernels.program import aligned, aligned_rows
from megastep.kernels.build.launch import launch_blocks

MAX_CHANNELS = PROGRAM.constants["CONV_INPUTS"]
_FEATURES, _ROWS, _THREADS, _BLOCKS = (
    PROGRAM.constants[f"CONV_{name}"] for name in ("CHANNELS", "ROWS", "THREADS", "BLOCKS")
)
_RESERVED = 1024  # bytes of shared memory that each block needs besides its own
_BARRIER = 16  # bytes of a barrier for copies
_WORD = 8  # numbers in 16 bytes


def is_supported(rows: torch.Tensor, n_channels: int) -> bool:
    """Returns whether the kernel takes rows (N, C W) of this dtype on their device."""
    if not (rows.is_cuda and rows.dtype == torch.bfloat16 and n_channels <= MAX_CHANNELS):
        return False
    gpu = torch.cuda.get_device_properties(rows.device)
    n_bytes = _sizes(n_channels, rows.shape[1] // n_channels)[-1]
    return gpu.major >= 9 and n_bytes <= gpu.shared_memory_per_block_optin


def conv_backward(
    d_features: torch.Tensor,
    features: torch.Tensor,
    rows: torch.Tensor,
    first_weight: torch.Tensor,
    first_bias: torch.Tensor,
    second_weight: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Computes the gradients of both convolutions.

    Args:
        d_features: (N, F W'), the gradient after the second ReLU.
        features: (N, F W'), after the second ReLU.
        rows: (N, C W), for which `is_supported`. A row is contiguous.
        first_weight: (F, C, 8).
        first_bias: (F,).
        second_weight: (F, F, 4).

    Returns:
        The gradients of the first weight and bias, and of the second weight and bias, in their
        shapes, float32. The same inputs give the same bits on GPUs of one model.
    """
    n_rows, n_channels = len(rows), first_weight.shape[1]
    gpu = torch.cuda.get_device_properties(rows.device)
    n_columns = rows.shape[1] // n_channels
    n_blocks = _n_blocks(n_rows, n_channels, n_columns, gpu)
    n_sums = first_weight.numel() + second_weight.numel() + 2 * _FEATURES
    sums = first_weight.new_empty(n_blocks, n_sums, dtype=torch.float32)
    d_features, features = aligned_rows(d_features), aligned_rows(features)
    launch(
        (n_blocks, 1),
        n_columns,
        d_features=d_features,
        features=features,
        rows=rows,
        first_weight=aligned(first_weight),
        first_bias=first_bias.contiguous(),
        second_weight=aligned(second_weight),
        sums=sums,
        n_rows=n_rows,
        n_channels=n_channels,
        d_stride=d_features.stride(0),
        feature_stride=features.stride(0),
        row_stride=rows.stride(0),
    )
    parts = sum_rows(sums).split(
        [first_weight.numel(), _FEATURES, second_weight.numel(), _FEATURES]
    )
    return parts[0].view_as(first_weight), parts[1], parts[2].view_as(second_weight), parts[3]


def launch(n_blocks: tuple[int, int], n_columns: int, **fields) -> None:
    """Launches the kernel.

    Args:
        n_blocks: per policy, and policies.
        n_columns: W.
        fields: the other fields of its struct but the sizes in shared memory. A tensor stands for
            its address.
    """
    n_channels = fields["n_channels"]
    staged_size, image_size, n_bytes = _sizes(n_channels, n_columns)
    kernel = f"conv_backward_{n_channels + n_channels % 2}"
    pack = getattr(PROGRAM.params, PROGRAM.cuda_operations[kernel])
    values = {
        name: field.data_ptr() if isinstance(field, torch.Tensor) else field
        for name, field in fields.items()
    }
    packed = pack(**values, n_columns=n_columns, staged_size=staged_size, image_size=image_size)
    device = fields["sums"].device
    launch_blocks(PROGRAM, kernel, packed, device, n_blocks, _THREADS, n_bytes)


def _n_blocks(n_rows, n_channels, n_columns, gpu):
    """Returns how many blocks run at once, at most one per tile."""
    n_bytes = _sizes(n_channels, n_columns)[-1] + _RESERVED
    per_processor = min(_BLOCKS, gpu.shared_memory_per_multiprocessor // n_bytes)
    return max(min(-(-n_rows // _ROWS), per_processor * gpu.multi_processor_count), 1)


def _sizes(n_channels, n_columns):
    """Returns the numbers of a row's features and of a row in shared memory, and a block's bytes
    of it. Rows start in other banks than the rows before.
    """
    n_outputs = (n_columns // 4 + 1) // 2 + 1
    n_pairs = -(-n_channels // 2)
    staged_size = _FEATURES * n_outputs + 2 * _WORD
    image_size = _WORD * (n_pairs * (n_columns // 4 + 2) | 1)
    tile = 2 * _ROWS * (2 * staged_size + _FEATURES * n_outputs + 2 * image_size)
    tile += 2 * _FEATURES * n_outputs
    sums = 4 * 64 * (76 + 8 * n_pairs)  # float32, of two warps
    return staged_size, image_size, _BARRIER + max(tile, sums)
