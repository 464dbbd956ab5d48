"""Detects ranks that differ in weights, code or configuration."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch

from megastep.agents.distributed.pooling import all_gather
from megastep.agents.distributed.process_group import gather_objects, n_ranks, waiting

#: Integer dtype of each item size, to view the bits of floats.
INTEGERS = {1: torch.int8, 2: torch.int16, 4: torch.int32, 8: torch.int64}


class DriftError(RuntimeError):
    """The ranks' weights differ, so they no longer train one policy."""


def first_difference(policy: torch.nn.Module, extra: Sequence[torch.Tensor] = ()) -> str | None:
    """Compares the weights of all ranks. Synchronises, and waits for the other ranks.

    Args:
        policy: its parameters and buffers are compared.
        extra: what else a learner trains.

    Returns:
        The first parameter or buffer with different bits, such as `policy.core.bias differs on rank
        1`; None if all are equal.
    """
    if n_ranks() == 1:
        return None
    tensors = {**dict(policy.named_parameters()), **dict(policy.named_buffers())}
    tensors |= {f"extra.{i}": tensor for i, tensor in enumerate(extra)}
    with waiting():
        rows = all_gather(checksums(tensors.values())).T.tolist()
    for name, sums in zip(tensors, rows, strict=True):
        if different := [rank for rank, value in enumerate(sums) if value != sums[0]]:
            return f"policy.{name} differs on {_ranks(different)}"
    return None


def check_drift(policy: torch.nn.Module, extra: Sequence[torch.Tensor] = ()) -> None:
    """Checks that all ranks have the same weights. Synchronises, and waits for the other ranks.

    Raises:
        DriftError: on all ranks, naming the first parameter or buffer that differs.
    """
    if difference := first_difference(policy, extra):
        raise DriftError(
            f"The ranks drift apart: {difference}; a learner averages gradients with "
            "megastep.agents.distributed.pooling.average_gradients"
        )


def checksums(tensors: Iterable[torch.Tensor]) -> torch.Tensor:
    """Returns the sum of the bits of each of n tensors as integers, mod 2^64: (n,) int64."""
    with torch.no_grad():
        parts = [_bits(tensor.detach()).sum(dtype=torch.int64) for tensor in tensors]
        return torch.stack(parts) if parts else torch.zeros(0, dtype=torch.int64)


def _bits(tensor) -> torch.Tensor:
    if tensor.is_complex():
        tensor = torch.view_as_real(tensor)
    return tensor if tensor.dtype == torch.bool else tensor.view(INTEGERS[tensor.element_size()])


def first_differing_fact(facts: dict[str, object]) -> str | None:
    """Compares facts, such as versions and settings, of all ranks. Waits for the other ranks.

    Args:
        facts: this rank's facts by name, the most important first.

    Returns:
        The first that differs, such as `learner.lr is 0.001 on rank 0, and 0.01 on ranks 1 and 3`;
        None if all are equal.
    """
    everyones = gather_objects({name: str(value) for name, value in facts.items()})
    for name in dict.fromkeys(name for theirs in everyones for name in theirs):
        holders: dict[str, list[int]] = {}
        for rank, theirs in enumerate(everyones):
            holders.setdefault(theirs.get(name, "missing"), []).append(rank)
        if len(holders) > 1:
            values = (f"{value} on {_ranks(ranks)}" for value, ranks in holders.items())
            return f"{name} is {', and '.join(values)}"
    return None


def _ranks(ranks) -> str:
    *others, last = map(str, ranks)
    return f"ranks {', '.join(others)} and {last}" if others else f"rank {last}"
