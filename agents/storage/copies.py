"""Copies and index selections of many tensors, each in one kernel."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch.utils._pytree import tree_flatten, tree_unflatten

from megastep.kernels.build.copies import MAX_BYTES
from megastep.kernels.build.copies import copy_all as copy_all
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import BLOCK, Blocks, launch
from megastep.types import Tree

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
_BLOCK_WORDS = BLOCK * LIBRARY.constants["COPY_WORDS"]
_MAX_SELECTED = LIBRARY.constants["MAX_SELECTED"]


def select_lanes(tensors: Sequence[torch.Tensor], lanes: torch.Tensor) -> list[torch.Tensor]:
    """Returns `tensor.index_select(1, lanes)` of tensors (T, B, ...), on a GPU in one kernel."""
    if not lanes.is_cuda:
        return [tensor.index_select(1, lanes) for tensor in tensors]
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
            n_words = n_bytes // word_size
            sizes = dict(n_steps=n_steps, n_words=n_words, word_size=word_size)
            fields = dict(target=results[i], source=tensor, first_block=n_blocks, **sizes)
            rows.append(LIBRARY.params.SelectParams(**fields))
            n_blocks += -(-n_steps * len(lanes) * n_words // _BLOCK_WORDS)
        sizes = dict(n_lanes=tensors[chosen[0]].shape[1], n_selected=len(lanes))
        launch(
            *(LIBRARY, "select_lanes", lanes.device, Blocks(n_blocks)),
            **dict(tensors=b"".join(rows), lanes=lanes, n_tensors=len(rows), **sizes),
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
    is_small = 0 < n_bytes * max(n_selected, tensor.shape[1]) < MAX_BYTES
    return tensor.is_cuda and tensor.is_contiguous() and is_small
