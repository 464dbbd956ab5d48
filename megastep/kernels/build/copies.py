"""Copies of many tensors in one kernel."""

from collections.abc import Iterable, Sequence

import torch

from megastep.kernels.build.kernel_library import KERNELS, KernelLibrary
from megastep.kernels.build.launch import BLOCK, Blocks, launch

LIBRARY = KernelLibrary(KERNELS / "copies")
MAX_BYTES = 2**31  # of a tensor that kernels copy
_MAX_COPIES = LIBRARY.constants["MAX_COPIES"]
_BLOCK_BYTES = 16 * BLOCK * LIBRARY.constants["COPY_WORDS"]


def copy_all(
    pairs: Iterable[tuple[torch.Tensor, torch.Tensor]], condition: torch.Tensor | None = None
) -> None:
    """Copies the second tensor of each pair into the first, as `Tensor.copy_` does, unless a
    condition, () bool on the device, is false.

    On a GPU, contiguous tensors of equal dtype and shape are copied by one kernel. Copies run in
    any order, so a target must not share memory with another tensor of the pairs.
    """
    pairs = list(pairs)  # keeps sources alive until the launch
    fused = []
    for target, source in pairs:
        if target.is_cuda and _is_plain_copy(target, source):
            fused.append((target.data_ptr(), source))
        else:
            if condition is not None:
                source = torch.where(condition, source.to(target.device), target)
            target.copy_(source)
    copy_bytes(fused, condition)


def either(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Returns (B,) bool: where either of two (B,) bool is true. In a CUDA graph it is quicker than
    PyTorch's own kernel, which those around it cannot overlap.
    """
    if not (one.is_cuda and one.is_contiguous() and other.is_contiguous()):
        return one | other
    out = torch.empty_like(one)
    launch(LIBRARY, "either", one.device, len(one), one=one, other=other, out=out, n=len(one))
    return out


def copy_bytes(
    copies: Sequence[tuple[int, torch.Tensor]],
    condition: torch.Tensor | None = None,
    row: torch.Tensor | None = None,
    row_bytes: int = 0,
) -> None:
    """Copies contiguous tensors on a GPU to addresses; or to offsets in a row whose address is in
    ``row``, (2,) int64 with a 0 behind, and then adds ``row_bytes`` to that address.
    """
    for start in range(0, len(copies), _MAX_COPIES):
        rows, n_blocks = [], 0
        for target, source in copies[start : start + _MAX_COPIES]:
            is_aligned = not (target | source.data_ptr()) % 16
            fields = dict(first_block=n_blocks, is_aligned=int(is_aligned))
            fields |= dict(target=target, n_bytes=source.nbytes)
            rows.append(LIBRARY.params.CopyParams(source=source, **fields))
            n_blocks += -(-source.nbytes // _BLOCK_BYTES)
        is_last = start + _MAX_COPIES >= len(copies)
        launch(
            *(LIBRARY, "copy_all", copies[0][1].device, Blocks(n_blocks)),
            **dict(copies=b"".join(rows), condition=condition, row=row),
            row_bytes=row_bytes if is_last else 0,
            n_copies=len(rows),
        )


def _is_plain_copy(target, source) -> bool:
    return (
        source.device == target.device
        and source.dtype == target.dtype
        and source.shape == target.shape
        and source.is_contiguous()
        and target.is_contiguous()
        and target.nbytes < MAX_BYTES
    )
