"""The dtype that layers compute in."""

import math
import threading
from collections.abc import Callable, Iterable
from typing import Any

import torch


class _Casts(threading.local):
    """What `cast` returned since the outermost `ComputeDtype` of this thread began."""

    depth = 0

    def __init__(self):
        # with the weights themselves, so that no other gets their id
        self.by_weight: dict[tuple, tuple[Any, torch.Tensor]] = {}
        self.weights: Callable[[], Iterable[torch.Tensor]] = tuple


_CASTS = _Casts()
_MULTIPLE = 8  # rows that tensor cores want; the only padding of weights that are cast together


class ComputeDtype(torch.autocast):
    """Autocast that also remembers what `cast` returned: until the outermost context ends, each
    weight is cast only once. Weights must not change inside it.

    Args:
        args: autocast's arguments.
        weights: returns weights that are cast together, on a GPU, once one of them is needed.
        options: autocast's arguments.
    """

    def __init__(
        self, *args: Any, weights: Callable[[], Iterable[torch.Tensor]] = tuple, **options: Any
    ):
        super().__init__(*args, **options)
        self._weights = weights

    def __enter__(self) -> Any:
        if not _CASTS.depth:
            _CASTS.weights = self._weights
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
    if key not in _CASTS.by_weight and _CASTS.depth and weight.is_cuda:
        _cast_together(weight, dtype)
    if key in _CASTS.by_weight:
        return _CASTS.by_weight[key][1]
    result = weight.detach().to(dtype)
    if n_padding:
        result = torch.cat([result, result.new_zeros(n_padding, *weight.shape[1:])])
    if _CASTS.depth:
        _CASTS.by_weight[key] = weight, result
    return result


def cast_joined(weights: tuple[torch.Tensor, ...], dtype: torch.dtype) -> torch.Tensor:
    """Returns weights (N, n) each, cast as by `cast` and joined along columns: (N, sum of n)."""
    key = tuple(id(weight) for weight in weights), dtype
    if key not in _CASTS.by_weight:
        result = torch.cat([cast(weight, dtype).detach() for weight in weights], 1)
        if not _CASTS.depth:
            return result
        _CASTS.by_weight[key] = weights, result
    return _CASTS.by_weight[key][1]


@torch.no_grad()
def _cast_together(weight, dtype):
    """Casts all weights of the context, if this is one of them: two kernels instead of one or two
    for each.
    """
    weights = [w for w in _CASTS.weights() if w.dim() and w.dtype == weight.dtype and w.is_cuda]
    if not any(w is weight for w in weights):
        return
    shapes = [(len(w) + -len(w) % _MULTIPLE, *w.shape[1:]) for w in weights]
    sizes = [math.prod(shape) for shape in shapes]
    padded = torch.zeros(sum(sizes), dtype=dtype, device=weight.device).split(sizes)
    padded = [part.view(shape) for part, shape in zip(padded, shapes, strict=True)]
    plain = [part[: len(w)] for part, w in zip(padded, weights, strict=True)]
    torch._foreach_copy_(plain, weights)
    for w, part, whole in zip(weights, plain, padded, strict=True):
        _CASTS.by_weight[id(w), dtype, 1] = w, part
        _CASTS.by_weight[id(w), dtype, _MULTIPLE] = w, whole


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
