"""Detects ranks whose weights differ."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch

from megastep.agents.distributed.pooling import all_gather
from megastep.agents.distributed.process_group import n_ranks, waiting

#: Integer dtype of each item size, to view the bits of floats.
INTEGERS = {1: torch.int8, 2: torch.int16, 4: torch.int32, 8: torch.int64}


class DriftError(RuntimeError):
    """The ranks' weights differ, so they no longer train one policy."""


def check_drift(policy: torch.nn.Module, extra: Sequence[torch.Tensor] = ()) -> None:
    """Checks that all ranks have the same weights. Synchronises, and waits for the other ranks.

    Args:
        policy: its parameters and buffers are compared.
        extra: what else a learner trains.

    Raises:
        DriftError: on all ranks, naming the first parameter or buffer with different bits.
    """
    if n_ranks() == 1:
        return
    tensors = {**dict(policy.named_parameters()), **dict(policy.named_buffers())}
    tensors |= {f"extra.{i}": tensor for i, tensor in enumerate(extra)}
    with waiting():
        rows = all_gather(checksums(tensors.values())).T.tolist()
    for name, sums in zip(tensors, rows, strict=True):
        if different := [rank for rank, value in enumerate(sums) if value != sums[0]]:
            raise DriftError(
                f"The ranks drift apart: policy.{name} differs on {ranks_named(different)}; a "
                "learner averages gradients with "
                "megastep.agents.distributed.pooling.average_gradients"
            )


def checksums(tensors: Iterable[torch.Tensor]) -> torch.Tensor:
    """Returns the sum of the bits of each of n tensors as integers, mod 2^64: (n,) int64."""
    with torch.no_grad():
        bits = [tensor.detach().view(INTEGERS[tensor.element_size()]) for tensor in tensors]
        return torch.stack([part.sum(dtype=torch.int64) for part in bits])


def ranks_named(ranks: Sequence[int]) -> str:
    """Returns `rank 1` or `ranks 1, 2 and 5`."""
    *others, last = map(str, ranks)
    return f"ranks {', '.join(others)} and {last}" if others else f"rank {last}"
