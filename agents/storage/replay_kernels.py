"""The replay buffer on a GPU: a kernel each draws indices, reads sequences and sets priorities.

All tensors are contiguous, on one GPU. M indices or sequences, L steps of a sequence, B lanes, T
steps and K rollouts of the buffer.
"""

import math
from collections.abc import Sequence

import torch

from megastep.agents.storage.copies import LIBRARY
from megastep.kernels.build.launch import WARP, Blocks, launch

MAX_LEVELS = LIBRARY.constants["MAX_LEVELS"]
MAX_SET = LIBRARY.constants["MAX_SET"]  # indices of `set_tree` and `set_priorities`
FAN_OUT = WARP  # children of a node
_MAX_TENSORS = LIBRARY.constants["MAX_SELECTED"]
_SET_THREADS, _READ_THREADS = (LIBRARY.constants[f"{name}_THREADS"] for name in ("SET", "READ"))
_MAX_ENTRIES = 2**31  # kernels count lanes, rows and words in 32 bits
_COPIES = {size: LIBRARY.constants[f"COPY_{size}"] for size in (16, 8, 4, 2, 1)}
#: How a stored dtype is read as another.
_CONVERSIONS = {
    (torch.uint8, torch.int64): LIBRARY.constants["BYTE_TO_LONG"],
    (torch.int16, torch.int64): LIBRARY.constants["SHORT_TO_LONG"],
    (torch.int32, torch.int64): LIBRARY.constants["INT_TO_LONG"],
    (torch.uint8, torch.float16): LIBRARY.constants["BYTE_TO_HALF"],
    (torch.uint8, torch.float32): LIBRARY.constants["BYTE_TO_FLOAT"],
    (torch.float16, torch.float32): LIBRARY.constants["HALF_TO_FLOAT"],
}


def draw(
    levels: Sequence[torch.Tensor], fractions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Draws an index from each of M equal parts of a sum tree's total.

    Args:
        levels: of the tree, (blocks, FAN_OUT) float64 each.
        fractions: (M,) float64 from 0 to 1, where in its part.

    Returns:
        indices (M,) int64 and their probabilities (M,) float64.
    """
    index = torch.empty_like(fractions, dtype=torch.int64)
    probability = torch.empty_like(fractions)
    launch(
        *(LIBRARY, "sample_tree", fractions.device, WARP * len(fractions)),
        tree=_packed(levels),
        fractions=fractions,
        index=index,
        probability=probability,
        n_samples=len(fractions),
    )
    return index, probability


def set_tree(levels: Sequence[torch.Tensor], index: torch.Tensor, values: torch.Tensor) -> None:
    """Does `SumTree.set`.

    Args:
        levels: as for `draw`.
        index: (n,) int64.
        values: (n,) float64.
    """
    launch(
        *(LIBRARY, "set_tree", index.device, Blocks(1, threads=_SET_THREADS)),
        tree=_packed(levels),
        index=index,
        values=values,
        n=len(index),
    )


def set_priorities(
    levels: Sequence[torch.Tensor],
    index: torch.Tensor,
    errors: torch.Tensor,
    counts: tuple[torch.Tensor, torch.Tensor],
    new_priority: torch.Tensor,
    first_rollouts: int,
    smallest: float,
    alpha: float,
) -> None:
    """Does `ReplayBuffer.set_priorities`.

    Args:
        levels: as for `draw`.
        index: (n,) int64.
        errors: (n,) float32.
        counts: (), the rollouts added in total and the sequences that can be drawn, int64.
        new_priority: () float64, updated.
        first_rollouts: without that many rollouts nothing changes.
        smallest: smallest error.
        alpha: exponent.
    """
    values = torch.empty_like(errors, dtype=torch.float64)
    launch(
        *(LIBRARY, "set_priorities", index.device, Blocks(1, threads=_SET_THREADS)),
        tree=_packed(levels),
        index=index,
        errors=errors,
        values=values,
        n_added=counts[0],
        n_available=counts[1],
        new_priority=new_priority,
        n=len(index),
        first_rollouts=min(first_rollouts, _MAX_ENTRIES - 1),
        smallest=smallest,
        alpha=alpha,
    )


def can_read(tensors: Sequence[tuple[torch.Tensor, torch.dtype]], n_words: int) -> bool:
    """Returns whether `read_sequences` reads these tensors.

    Args:
        tensors: rows (R, B, ...) of the ring, and the dtype to return.
        n_words: entries of a sequence's tensors times the words of the largest entry, at most.
    """
    return len(tensors) <= _MAX_TENSORS and all(
        rows.is_cuda
        and rows.is_contiguous()
        and (rows.dtype == dtype or (rows.dtype, dtype) in _CONVERSIONS)
        and rows.shape[0] * rows.shape[1] < _MAX_ENTRIES
        and n_words * math.prod(rows.shape[2:]) * rows.element_size() < _MAX_ENTRIES
        for rows, dtype in tensors
    )


def read_sequences(
    tensors: Sequence[tuple[torch.Tensor, torch.dtype, int]],
    flags: torch.Tensor,
    index: torch.Tensor,
    probability: torch.Tensor,
    counts: tuple[torch.Tensor, torch.Tensor],
    n_steps: int,
    n_rollouts: int,
    beta: float,
) -> tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor, torch.Tensor]:
    """Reads sequences, with their importance weights and ages.

    Args:
        tensors: rows (R, B, ...) of the ring, the dtype to return, and how many rows to return. R
            is K T, or K for hidden states.
        flags: (K T, B) uint8, four bits.
        index: (M,) int64, slot x B + lane.
        probability: (M,) float64.
        counts: (), the rollouts added in total and the sequences that can be drawn, int64.
        n_steps: L.
        n_rollouts: K.
        beta: exponent of the weights.

    Returns:
        the tensors (rows, M, ...), the four flags, (L + 1, M), (L + 1, M), (L, M) and (L, M) bool,
        weights (M,) float32 and ages (M,) int64.
    """
    n_sequences, device, packed = len(index), index.device, []
    results, n_blocks = [], 1 + -(-(n_steps + 1) * n_sequences // _READ_THREADS)
    for rows, dtype, n_rows in tensors:
        result = torch.empty(n_rows, n_sequences, *rows.shape[2:], dtype=dtype, device=device)
        n_words, kind = math.prod(rows.shape[2:]), _CONVERSIONS.get((rows.dtype, dtype))
        if rows.dtype == dtype:
            n_bytes = n_words * rows.element_size()
            addresses = n_bytes | rows.data_ptr() | result.data_ptr()
            word_size = next(size for size in _COPIES if not addresses % size)
            n_words, kind = n_bytes // word_size, _COPIES[word_size]
        packed.append(
            LIBRARY.params.ReadTensorParams(
                target=result,
                source=rows,
                n_rows=n_rows,
                n_words=n_words,
                rows_per_rollout=len(rows) // n_rollouts,
                first_block=n_blocks,
                kind=kind,
            )
        )
        results.append(result)
        n_blocks += -(-n_rows * n_sequences * n_words // _READ_THREADS)
    lengths = n_steps + 1, n_steps + 1, n_steps, n_steps
    bools = [torch.empty(n, n_sequences, dtype=torch.bool, device=device) for n in lengths]
    weights, age = torch.empty_like(probability), torch.empty_like(index)
    weight = torch.empty_like(probability, dtype=torch.float32)
    launch(
        *(LIBRARY, "read_sequences", device, Blocks(n_blocks, threads=_READ_THREADS)),
        tensors=b"".join(packed),
        flags=flags,
        **dict(zip(("starts", "learns", "terminal", "truncated"), bools)),
        index=index,
        probability=probability,
        weights=weights,
        weight=weight,
        age=age,
        n_added=counts[0],
        n_available=counts[1],
        n_tensors=len(tensors),
        n_sequences=n_sequences,
        n_steps=n_steps,
        n_lanes=flags.shape[1],
        n_rollouts=n_rollouts,
        rows_per_rollout=len(flags) // n_rollouts,
        beta=beta,
    )
    return results, bools, weight, age


def _packed(levels) -> bytes:
    rows = [LIBRARY.params.TreeLevelParams(sums=level) for level in levels]
    return LIBRARY.params.SumTreeParams(levels=b"".join(rows), n_levels=len(levels))
