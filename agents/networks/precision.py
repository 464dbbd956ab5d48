"""The dtype that layers compute in."""

import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import torch

from megastep.agents.networks.fused import LIBRARY, is_plain_on_gpu
from megastep.kernels.build.launch import Blocks, launch

if TYPE_CHECKING:
    from typing_extensions import Self


Weights = Callable[[], Iterable[torch.Tensor]]


class _Casts(threading.local):
    """What `cast` returned since the outermost `ComputeDtype` of this thread began."""

    depth = 0
    weights: Weights = tuple

    def __init__(self) -> None:
        # with the weights themselves, so that no other gets their id
        self.by_weight: dict[tuple, tuple[object, torch.Tensor]] = {}


_CASTS = _Casts()
_MULTIPLE = 8  # rows that tensor cores want; the only padding of weights that are cast together
_MAX_ROWS, _THREADS = LIBRARY.constants["CAST_ROWS"], LIBRARY.constants["CAST_THREADS"]


class ComputeDtype(torch.autocast):
    """Autocast that casts each weight only once until the outermost context ends. Weights must not
    change inside it. Those that `weights` returns are cast together on a GPU.
    """

    def __init__(
        self, device_type: str, dtype: torch.dtype, enabled: bool = True, weights: Weights = tuple
    ):
        super().__init__(device_type, dtype, enabled)
        self._weights = weights

    def __enter__(self) -> "Self":
        self._outer_weights, _CASTS.weights = _CASTS.weights, self._weights
        _CASTS.depth += 1
        super().__enter__()
        return self

    def __exit__(self, *args: object) -> None:
        _CASTS.weights = self._outer_weights
        _CASTS.depth -= 1
        if not _CASTS.depth:
            _CASTS.by_weight.clear()
        super().__exit__(*args)


def cast(weight: torch.Tensor, dtype: torch.dtype, multiple: int = 1) -> torch.Tensor:
    """Returns a weight (N, ...) in another dtype, without autograd. Rows of zeros are added until
    there are a multiple of `multiple`.
    """
    n_padding = -len(weight) % multiple
    if weight.dtype == dtype and not n_padding:
        return weight
    key = id(weight), dtype, multiple
    if key not in _CASTS.by_weight and _CASTS.depth and dtype == torch.bfloat16:
        _cast_together(weight)
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
    key = *(id(weight) for weight in weights), dtype
    if key in _CASTS.by_weight:
        return _CASTS.by_weight[key][1]
    result = torch.cat([cast(weight, dtype).detach() for weight in weights], 1)
    if _CASTS.depth:
        _CASTS.by_weight[key] = weights, result
    return result


@torch.no_grad()
def _cast_together(weight) -> None:
    """Rounds all weights of the context to bfloat16 in one kernel, if this is one of them."""
    weights = [w for w in _CASTS.weights() if w.dim() and is_plain_on_gpu(w)]
    if not any(w is weight for w in weights):
        return
    for w, padded in zip(weights, rounded(weights), strict=True):
        _CASTS.by_weight[id(w), torch.bfloat16, 1] = w, padded[: len(w)]
        _CASTS.by_weight[id(w), torch.bfloat16, _MULTIPLE] = w, padded


def rounded(weights: list[torch.Tensor]) -> list[torch.Tensor]:
    """Returns weights (N, ...) float32, contiguous on a GPU, in bfloat16, with rows of zeros up to
    a multiple of 8.
    """
    shapes = [(len(weight) + -len(weight) % _MULTIPLE, *weight.shape[1:]) for weight in weights]
    sizes = [torch.Size(shape).numel() for shape in shapes]
    memory = torch.empty(sum(sizes), dtype=torch.bfloat16, device=weights[0].device)
    targets = memory.split(sizes)
    for start in range(0, len(weights), _MAX_ROWS):
        some, rows, n_blocks = slice(start, start + _MAX_ROWS), [], 0
        for weight, target in zip(weights[some], targets[some], strict=True):
            numbers = dict(n=weight.numel(), n_padded=target.numel(), first_block=n_blocks)
            rows.append(LIBRARY.params.CastRowParams(source=weight, target=target, **numbers))
            n_blocks += max(1, -(-target.numel() // (8 * _THREADS)))
        blocks = Blocks(n_blocks, threads=_THREADS)
        launch(LIBRARY, "cast", memory.device, blocks, rows=b"".join(rows), n_rows=len(rows))
    return [target.view(shape) for target, shape in zip(targets, shapes, strict=True)]


def compute_dtype(weight: torch.Tensor) -> torch.dtype:
    """Returns the dtype of a matrix product with `weight`: autocast's if it is on, else the
    weight's own.
    """
    device = weight.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else weight.dtype
