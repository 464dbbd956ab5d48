"""Copies of many tensors at once."""

from collections.abc import Iterable
from pathlib import Path

import torch

from megastep.kernels.build.launch import BLOCK, launch_blocks
from megastep.kernels.build.program import Program

PROGRAM = Program(Path(__file__).parent / "kernels")
_MAX_COPIES = PROGRAM.constants["MAX_COPIES"]
_BLOCK_BYTES = 16 * BLOCK * PROGRAM.constants["COPY_WORDS"]
_MAX_BYTES = 2**31


def copy_all(pairs: Iterable[tuple[torch.Tensor, torch.Tensor]]) -> None:
    """Copies the second tensor of each pair into the first, as `Tensor.copy_` does.

    On a GPU contiguous tensors of equal dtype and shape are copied by one kernel: a copy of a few
    kilobytes takes no time, but its launch takes a microsecond. They are copied in no order, so no
    target may share memory with another tensor of the pairs.

    Args:
        pairs: targets and sources, all on one device but for sources on the host.
    """
    pairs = list(pairs)  # a source that nobody else holds lives until the launch
    packed, largest, device = [], 0, None
    for target, source in pairs:
        if not (target.is_cuda and _is_plain_copy(target, source)):
            target.copy_(source)
            continue
        n_bytes = target.numel() * target.element_size()
        is_aligned = not (target.data_ptr() | source.data_ptr()) % 16
        packed.append(
            PROGRAM.params.CopyParams(
                target=target.data_ptr(),
                source=source.data_ptr(),
                n_bytes=n_bytes,
                is_aligned=int(is_aligned),
            )
        )
        largest, device = max(largest, n_bytes), target.device
    for i in range(0, len(packed), _MAX_COPIES):
        rows = packed[i : i + _MAX_COPIES]
        struct = PROGRAM.params.CopyAllParams(copies=b"".join(rows), n_copies=len(rows))
        n_blocks = max(1, -(-largest // _BLOCK_BYTES)), len(rows)
        launch_blocks(PROGRAM, "copy_all", struct, device, n_blocks, BLOCK)


def _is_plain_copy(target, source):
    return (
        source.device == target.device
        and source.dtype == target.dtype
        and source.shape == target.shape
        and source.is_contiguous()
        and target.is_contiguous()
        and target.numel() * target.element_size() < _MAX_BYTES
    )
