"""Copies and index selections of many tensors in one kernel."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch.utils._pytree import tree_flatten, tree_unflatten

from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import BLOCK, Blocks, launch
from megastep.types import Tree, is_stored

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
_MAX_COPIES = LIBRARY.constants["MAX_COPIES"]
_BLOCK_WORDS = BLOCK * LIBRARY.constants["COPY_WORDS"]
_BLOCK_BYTES = 16 * _BLOCK_WORDS
_MAX_SELECTED = LIBRARY.constants["MAX_SELECTED"]
_MAX_BYTES = 2**31


def copy_all(
    pairs: Iterable[tuple[torch.Tensor, torch.Tensor]], condition: torch.Tensor | None = None
) -> None:
    """Copies the second tensor of each pair into the first, as `Tensor.copy_` does.

    On a GPU, contiguous tensors of equal dtype and shape are copied by one kernel, since launches
    take longer than copies of a few kilobytes. Copies run in any order, so a target must not share
    memory with another tensor of the pairs.

    Args:
        pairs: targets and sources, all on one device; sources may also be on the host.
        condition: () bool on the device; if false, nothing is copied. None copies always.
    """
    pairs = list(pairs)  # keeps sources alive until the launch
    fused = []
    for target, source in pairs:
        if target.is_cuda and _is_plain_copy(target, source):
            fused.append((target, source))
        else:
            if condition is not None:
                source = torch.where(condition, source.to(target.device), target)
            target.copy_(source)
    for start in range(0, len(fused), _MAX_COPIES):
        rows, n_blocks = [], 0
        for target, source in fused[start : start + _MAX_COPIES]:
            n_bytes = target.numel() * target.element_size()
            is_aligned = not (target.data_ptr() | source.data_ptr()) % 16
            rows.append(
                LIBRARY.params.CopyParams(
                    target=target,
                    source=source,
                    n_bytes=n_bytes,
                    first_block=n_blocks,
                    is_aligned=int(is_aligned),
                )
            )
            n_blocks += -(-n_bytes // _BLOCK_BYTES)
        launch(
            *(LIBRARY, "copy_all", fused[0][0].device, Blocks(n_blocks)),
            copies=b"".join(rows),
            condition=condition,
            n_copies=len(rows),
        )


def _is_plain_copy(target, source) -> bool:
    return (
        source.device == target.device
        and source.dtype == target.dtype
        and source.shape == target.shape
        and source.is_contiguous()
        and target.is_contiguous()
        and target.numel() * target.element_size() < _MAX_BYTES
    )


def select_lanes(tensors: Sequence[torch.Tensor], lanes: torch.Tensor) -> list[torch.Tensor]:
    """Returns `tensor.index_select(1, lanes)` of each tensor, on a GPU in one kernel.

    Args:
        tensors: (T, B, ...) each, T may differ.
        lanes: (M,) int64.
    """
    results = {}
    fused = [i for i, tensor in enumerate(tensors) if _can_select(tensor, len(lanes))]
    for start in range(0, len(fused), _MAX_SELECTED):
        chosen = fused[start : start + _MAX_SELECTED]
        rows, n_blocks = [], 0
        for i in chosen:
            tensor = tensors[i]
            n_steps, _, *rest = tensor.shape
            results[i] = tensor.new_empty(n_steps, len(lanes), *rest)
            n_bytes = math.prod(rest) * tensor.element_size()
            addresses = n_bytes | tensor.data_ptr() | results[i].data_ptr()
            word_size = next(size for size in (16, 8, 4, 1) if not addresses % size)
            rows.append(
                LIBRARY.params.SelectParams(
                    target=results[i],
                    source=tensor,
                    n_steps=n_steps,
                    n_words=n_bytes // word_size,
                    first_block=n_blocks,
                    word_size=word_size,
                )
            )
            n_blocks += -(-n_steps * len(lanes) * (n_bytes // word_size) // _BLOCK_WORDS)
        launch(
            *(LIBRARY, "select_lanes", lanes.device, Blocks(n_blocks)),
            tensors=b"".join(rows),
            lanes=lanes,
            n_lanes=tensors[chosen[0]].shape[1],
            n_selected=len(lanes),
            n_tensors=len(rows),
        )
    return [
        results[i] if i in results else tensor.index_select(1, lanes)
        for i, tensor in enumerate(tensors)
    ]


def select_tree(tree: Tree, lanes: torch.Tensor) -> Tree:
    """Returns `leaf.index_select(0, lanes)` of each leaf (B, ...) of a tree, on a GPU in one
    kernel.
    """
    leaves, spec = tree_flatten(tree)
    selected = select_lanes([leaf[None] for leaf in leaves], lanes)
    return tree_unflatten([leaf[0] for leaf in selected], spec)


def _can_select(tensor, n_selected) -> bool:
    n_bytes = tensor[:, :1].numel() * tensor.element_size()  # of one lane
    is_small = 0 < n_bytes * max(n_selected, tensor.shape[1]) < _MAX_BYTES
    return tensor.is_cuda and tensor.is_contiguous() and is_small


def require_stored(**tensors: torch.Tensor) -> None:
    """Raises ValueError naming a tensor that lies outside its storage: on a CPU, PyTorch's own
    operations would crash.
    """
    for name, tensor in tensors.items():
        if not is_stored(tensor):
            n_bytes = tensor.untyped_storage().nbytes()
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)}, but its storage has only {n_bytes} bytes"
            )
