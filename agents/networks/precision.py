"""The dtype that layers compute in."""

import threading
from typing import Any

import torch


class _Casts(threading.local):
    """What `cast` returned since the outermost `ComputeDtype` of this thread began."""

    depth = 0

    def __init__(self):
        self.by_weight: dict[tuple, tuple[torch.Tensor, torch.Tensor]] = {}


_CASTS = _Casts()


class ComputeDtype(torch.autocast):
    """Autocast that also remembers what `cast` returned: until the outermost context ends, each
    weight is cast only once. Weights must not change inside it.
    """

    def __enter__(self) -> Any:
        _CASTS.depth += 1
        return super().__enter__()

    def __exit__(self, *args: Any) -> Any:
        _CASTS.depth -= 1
        if not _CASTS.depth:
            _CASTS.by_weight.clear()
        return super().__exit__(*args)


def cast(weight: torch.Tensor, dtype: torch.dtype, multiple: int = 1) -> torch.Tensor:
    """Returns a weight in another dtype, for use without autograd.

    Args:
        weight: (N, ...).
        dtype: of the result.
        multiple: rows of zeros are added until there are a multiple of this.
    """
    n_padding = -len(weight) % multiple
    if weight.dtype == dtype and not n_padding:
        return weight
    key = id(weight), dtype, multiple
    if key in _CASTS.by_weight:
        return _CASTS.by_weight[key][1]
    result = weight.detach().to(dtype)
    if n_padding:
        result = torch.cat([result, result.new_zeros(n_padding, *weight.shape[1:])])
    if _CASTS.depth:
        # the weight is kept, so that no other gets its id
        _CASTS.by_weight[key] = weight, result
    return result


def compute_dtype(weight: torch.Tensor) -> torch.dtype:
    """Returns the dtype of a matrix product with `weight`: autocast's if it is on, else the
    weight's own.
    """
    device = weight.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else weight.dtype


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Returns the float32 product of two matrices of one dtype. A GPU does not round it to that."""
    if a.is_cuda and a.dtype != torch.float32:
        return torch.mm(a, b, out_dtype=torch.float32)
    return (a @ b).float()
