"""Checks of arguments. Their errors name the argument, what is allowed and what was given."""

import math
import numbers
import operator
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn, TypeVar

import torch

from megastep.ragged import RaggedTorch
from megastep.read_only import ReadOnlyTensor

T = TypeVar("T")

_INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
LIMIT = 1e9  # of numbers that kernels compute with: a product of four still fits into float32


def _refuse(name, wanted, value, kind: type[Exception] = ValueError) -> NoReturn:
    raise kind(f"{name} must be {wanted}, but {_described(value)} was given")


# ---- Values ----


def integer(name: str, value: object, min: int, max: float = math.inf) -> int:
    """Returns ``value`` as an int. ValueError unless it is an integer from ``min`` to ``max``."""
    try:
        number = operator.index(value)  # pyright: ignore[reportArgumentType]
        if min <= number <= max and not isinstance(value, bool):
            return number
    except (TypeError, RuntimeError, ValueError):
        pass
    range_ = f"from {min} to {max}" if max < math.inf else f"of at least {min}"
    _refuse(name, f"an integer {range_}", value)


def number(name: str, value: Any, min: float, max: float, unit: str = "", hint: str = "") -> float:
    """Returns ``value`` as a float. ValueError unless ``min < value < max``."""
    plain = type(value) is float or type(value) is int
    real = plain or isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not real or not min < value < max:  # pyright: ignore[reportOperatorIssue]
        kind = f"a number of {unit}" if unit else "a number"
        range_ = f"between {min:g} and {max:g}" if max < math.inf else f"above {min:g}"
        range_ = range_ if min > -math.inf else "that is finite"
        _refuse(name, f"{kind} {range_}{hint}", value)
    return float(value)


def flag(name: str, value: object) -> bool:
    """Returns ``value``. TypeError unless it is True or False."""
    if value is not True and value is not False:
        _refuse(name, "True or False", value, TypeError)
    return value


def word(name: str, value: object, words: Sequence[str]) -> str:
    """Returns ``value``. ValueError unless it is one of ``words``."""
    if not isinstance(value, str) or value not in words:
        _refuse(name, " or ".join(words), value)
    return value


def instance(name: str, value: object, kind: type[T]) -> T:
    """Returns ``value``. TypeError unless it is a ``kind``."""
    if not isinstance(value, kind):
        _refuse(name, f"a {kind.__name__}", value, TypeError)
    return value


def items(name: str, value: object) -> list:
    """Returns ``value`` as a list. TypeError or ValueError unless it is a list and not empty."""
    if isinstance(value, (str, dict)) or not isinstance(value, Iterable):
        _refuse(name, "a list", value, TypeError)
    values = list(value)
    if not values:
        raise ValueError(f"{name} must hold at least one, but an empty list was given")
    return values


def device(name: str, value: Any) -> torch.device:
    """Returns ``value`` as a torch.device. ValueError unless PyTorch knows it."""
    try:
        return torch.device(value)
    except (RuntimeError, TypeError):
        _refuse(name, "a device such as cpu or cuda", value)


# ---- Arrays, which are converted ----


def floats(name: str, value: Any, shape: Sequence, device: torch.device | None) -> torch.Tensor:
    """Returns ``value`` as a contiguous float32 tensor on ``device``. ValueError unless it is an
    array of that shape, in which a string stands for any size, and its numbers are below 1e9.
    """
    try:
        tensor = torch.as_tensor(value)
        tensor = tensor.clone() if isinstance(tensor, ReadOnlyTensor) else tensor
        tensor = tensor.to(device=device, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, NotImplementedError):
        tensor = None
    sizes = () if tensor is None else tensor.shape
    fits = len(sizes) == len(shape) and all(
        isinstance(size, str) or size == n for size, n in zip(shape, sizes)
    )
    if tensor is None or not fits:
        wanted = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
        _refuse(name, f"an array of numbers of shape ({wanted})", value)
    if not bool((tensor.abs() < LIMIT).all()):
        raise ValueError(
            f"{name} must hold numbers below {LIMIT:g}, but one is NaN, infinite or larger"
        )
    return tensor.contiguous()


def ragged(name: str, value: Any, shape: Sequence, device: torch.device | None) -> RaggedTorch:
    """Returns a Ragged with vals (*shape), as :func:`floats`, on ``device``. TypeError if none."""
    if not hasattr(value, "torchify"):
        _refuse(name, "a Ragged", value, TypeError)
    value = value.torchify()
    return RaggedTorch(floats(f"{name}.vals", value.vals, shape, device), value.widths.to(device))


# ---- Tensors, which are not: these copy nothing, and do not synchronise ----


def length(name: str, value: object, axis: int = 0) -> int:
    """Returns the size of a tensor's ``axis``. TypeError or ValueError unless it has that axis."""
    if not isinstance(value, torch.Tensor):
        _refuse(name, "a tensor", value, TypeError)
    if not -value.ndim <= axis < value.ndim:
        raise ValueError(f"{name} must have more axes than {_described(value)} has")
    return value.shape[axis]


def address(
    name: str,
    value: Any,
    shape: tuple[int, ...],
    dtype: torch.dtype,
    device: torch.device,
    is_optional: bool = False,
) -> int:
    """Returns the address of a contiguous tensor of that shape, dtype and device, or raises; a null
    pointer for None, if it ``is_optional``.
    """
    if is_optional and value is None:
        return 0
    try:
        fits = (
            value.dtype is dtype
            and value.device == device
            and value.shape == shape
            and value.is_contiguous()
        )
    except (AttributeError, RuntimeError):  # no tensor, or one without memory such as a sparse one
        fits = False
    if not fits:
        wanted = f"a contiguous {dtype} tensor of shape {tuple(shape)} on {device}"
        _refuse_tensor(name, wanted, value)
    return value.data_ptr()


def alike(name: str, value: Any, like: torch.Tensor) -> torch.Tensor:
    """Returns a tensor of the shape and dtype of ``like``, on its device, or raises."""
    fits = isinstance(value, torch.Tensor) and value.shape == like.shape
    if not fits or value.dtype != like.dtype or value.device != like.device:
        wanted = f"a {like.dtype} tensor of shape {tuple(like.shape)} on {like.device}"
        _refuse_tensor(name, wanted, value)
    return value


def lanes(name: str, value: Any, n_lanes: int, device: torch.device, dim: int = 0) -> torch.Tensor:
    """Returns ``value``. TypeError or ValueError unless it is a tensor on ``device``, of any shape,
    with one integer per lane, or ``dim`` float32 numbers.
    """
    is_right = isinstance(value, torch.Tensor) and value.device == device
    if dim:
        is_right = is_right and value.shape[-1:] == (dim,) and value.dtype == torch.float32
    else:
        is_right = is_right and value.dtype in _INTEGERS
    if not is_right or value.numel() != n_lanes * (dim or 1):
        kind = f"float32 numbers, {dim}" if dim else "integers, one"
        wanted = f"a tensor of {kind} for each of the {n_lanes} lanes, on {device}"
        _refuse_tensor(name, wanted, value)
    return value


def _refuse_tensor(name, wanted, value) -> NoReturn:
    _refuse(name, wanted, value, ValueError if isinstance(value, torch.Tensor) else TypeError)


def _described(value) -> str:
    if isinstance(value, torch.Tensor):
        if value.layout is not torch.strided:
            return f"a {value.layout} tensor"
        layout = "" if value.is_contiguous() else "non-contiguous "
        return f"a {layout}{value.dtype} tensor of shape {tuple(value.shape)} on {value.device}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"a {value.dtype} array of shape {tuple(value.shape)}"
    if value is None or isinstance(value, (bool, int, float, str)):
        return repr(value) if len(repr(value)) < 60 else f"a long {type(value).__name__}"
    return f"a {type(value).__name__}"
