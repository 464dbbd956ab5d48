"""Checks of arguments. Their errors name the argument, what is allowed and what was given."""

import math
import numbers
import operator
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import torch

from megastep.coefficients import on_device
from megastep.ragged import Ragged, RaggedTorch
from megastep.read_only import ReadOnlyTensor
from megastep.types import is_stored

__all__ = [
    "address",
    "alike",
    "device",
    "flag",
    "floats",
    "instance",
    "integer",
    "integers",
    "items",
    "lanes",
    "length",
    "number",
    "ragged",
    "stored",
    "vectors",
    "word",
]

T = TypeVar("T")

_INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
LIMIT = 1e9  # of numbers that kernels compute with: a product of four still fits into float32


def integer(name: str, value: object, min: int, max: float = math.inf) -> int:
    """Returns ``value`` as an int. ValueError unless it is an integer from ``min`` to ``max``."""
    number = value if type(value) is int else _index(value)
    if number is None or not min <= number <= max:
        range_ = f"from {min} to {max}" if max < math.inf else f"of at least {min}"
        raise ValueError(f"{name} must be an integer {range_}, but {_described(value)} was given")
    return number


def _index(value) -> int | None:
    """Returns a value as an int, or None if it is none."""
    if isinstance(value, bool) or isinstance(value, torch.Tensor) and not is_stored(value):
        return None
    try:
        return operator.index(value)
    except (TypeError, RuntimeError, ValueError):
        return None


def number(name: str, value: Any, min: float, max: float, unit: str = "", hint: str = "") -> float:
    """Returns ``value`` as a float. ValueError unless ``min < value < max``."""
    plain = type(value) is float or type(value) is int
    real = plain or isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not real or not min < value < max:  # pyright: ignore[reportOperatorIssue]
        kind = f"a number of {unit}" if unit else "a number"
        range_ = f"between {min:g} and {max:g}" if max < math.inf else f"above {min:g}"
        range_ = range_ if min > -math.inf else "that is finite"
        raise ValueError(f"{name} must be {kind} {range_}{hint}, but {_described(value)} was given")
    return float(value)


def weight(name: str, value: object, device: torch.device) -> torch.Tensor:
    """Returns a finite number, or a tensor () float32 with one, as such a tensor, which a kernel
    reads when it runs. TypeError or ValueError for anything else.
    """
    if isinstance(value, torch.Tensor):
        address(name, value, (), torch.float32, device)
        return value
    return on_device(number(name, value, -math.inf, math.inf), device)


def flag(name: str, value: object) -> bool:
    """Returns ``value``. TypeError unless it is True or False."""
    if value is not True and value is not False:
        raise TypeError(f"{name} must be True or False, but {_described(value)} was given")
    return value


def word(name: str, value: object, words: Sequence[str]) -> str:
    """Returns ``value``. ValueError unless it is one of ``words``."""
    if not isinstance(value, str) or value not in words:
        raise ValueError(f"{name} must be {' or '.join(words)}, but {_described(value)} was given")
    return value


def instance(name: str, value: object, kind: type[T]) -> T:
    """Returns ``value``. TypeError unless it is a ``kind``."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be a {kind.__name__}, but {_described(value)} was given")
    return value


def items(name: str, value: object) -> list:
    """Returns ``value`` as a list. TypeError or ValueError unless it is a list and not empty."""
    if isinstance(value, (str, dict)) or not isinstance(value, Iterable):
        raise TypeError(f"{name} must be a list, but {_described(value)} was given")
    values = list(value)
    if not values:
        raise ValueError(f"{name} must hold at least one, but an empty list was given")
    return values


def device(name: str, value: Any) -> torch.device:
    """Returns ``value`` as a torch.device. ValueError unless PyTorch knows it."""
    try:
        return torch.device(value)
    except (RuntimeError, TypeError):
        raise ValueError(
            f"{name} must be a device such as cpu or cuda, but {_described(value)} was given"
        ) from None


def floats(name: str, value: Any, shape: Sequence, device: torch.device | None) -> torch.Tensor:
    """Returns ``value`` as a contiguous float32 tensor on ``device``.

    Args:
        shape: sizes; a string stands for any size.

    Raises:
        ValueError: unless it is an array of that shape whose numbers are below 1e9.
    """
    try:
        tensor = value if isinstance(value, torch.Tensor) else torch.as_tensor(value)
        usable = is_stored(tensor) and not tensor.is_complex()
        tensor = tensor.clone() if isinstance(tensor, ReadOnlyTensor) else tensor
        tensor = tensor.resolve_neg().to(device=device, dtype=torch.float32) if usable else None
    except (TypeError, ValueError, RuntimeError, NotImplementedError):
        tensor = None
    if tensor is None or not _fits(tensor, shape):
        raise ValueError(
            f"{name} must be an array of numbers of shape ({_sizes(shape)}), but "
            f"{_described(value)} was given"
        )
    if not bool((tensor.abs() < LIMIT).all()):
        raise ValueError(
            f"{name} must hold numbers below {LIMIT:g}, but one is NaN, infinite or larger"
        )
    return tensor.contiguous()


def integers(
    name: str, value: Any, size: int | str, min: int, max: int, device: torch.device
) -> torch.Tensor:
    """Returns a copy of ``value`` as an int64 tensor of shape (size,) on ``device``.

    Args:
        size: a string stands for any size.

    Raises:
        ValueError: unless all are integers from ``min`` to ``max``.
    """
    try:
        tensor = torch.as_tensor(value).detach()
        real = tensor.is_floating_point() or tensor.is_complex() or tensor.dtype == torch.bool
        usable = is_stored(tensor) and not (real and tensor.numel())
        tensor = tensor.clone().to(device=device, dtype=torch.int64) if usable else None
    except (TypeError, ValueError, RuntimeError, NotImplementedError):
        tensor = None
    if tensor is None or not _fits(tensor, (size,)):
        raise ValueError(
            f"{name} must be an array of integers of shape ({size},), but "
            f"{_described(value)} was given"
        )
    outside = tensor[(tensor < min) | (tensor > max)]
    if len(outside):
        raise ValueError(
            f"{name} must hold integers from {min} to {max}, but one is {int(outside[0])}"
        )
    return tensor


def _fits(tensor, shape) -> bool:
    return tensor.ndim == len(shape) and all(
        isinstance(size, str) or size == n for size, n in zip(shape, tensor.shape)
    )


def ragged(name: str, value: Any, shape: Sequence, device: torch.device | None) -> RaggedTorch:
    """Returns ``value`` as a Ragged of contiguous float32 tensors on ``device``.

    Raises:
        TypeError: unless it is a Ragged.
        ValueError: unless its vals pass :func:`floats`.
    """
    if not isinstance(value, Ragged) and not hasattr(value, "torchify"):
        raise TypeError(f"{name} must be a Ragged, but {_described(value)} was given")
    value = value.torchify()
    return RaggedTorch(floats(f"{name}.vals", value.vals, shape, device), value.widths.to(device))


def length(name: str, value: object, axis: int = 0) -> int:
    """Returns the size of a tensor's ``axis``. TypeError or ValueError unless it has that axis."""
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{name} must be a tensor, but {_described(value)} was given")
    if not -value.ndim <= axis < value.ndim:
        raise ValueError(f"{name} must have more axes than {_described(value)} has")
    return value.shape[axis]


def address(
    name: str, value: Any, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> int:
    """Returns a tensor's address. Copies nothing and does not synchronise.

    Raises:
        TypeError: unless it is a tensor.
        ValueError: unless it is contiguous, on ``device``, of that shape and dtype, and inside its
            storage, which may have been resized.
    """
    try:
        fits = (
            value.dtype is dtype
            and value.device == device
            and value.shape == shape
            and value.is_contiguous()
            and not value.is_neg()
            and value.storage_offset() * value.itemsize + value.nbytes
            <= value.untyped_storage().nbytes()
        )
    except (AttributeError, RuntimeError):  # no tensor, or one without memory such as a sparse one
        fits = False
    if not fits:
        raise (ValueError if isinstance(value, torch.Tensor) else TypeError)(
            f"{name} must be a contiguous {dtype} tensor of shape {tuple(shape)} on {device}, but "
            f"{_described(value)} was given"
        )
    return value.data_ptr()


def stored(name: str, tensor: torch.Tensor) -> torch.Tensor:
    """Returns ``tensor``. ValueError unless it lies inside its storage: most functions of PyTorch
    crash the interpreter if the storage was resized.
    """
    if not is_stored(tensor):
        raise ValueError(f"{name} must lie inside its storage, but is {_described(tensor)}")
    return tensor


def alike(name: str, value: Any, like: torch.Tensor) -> torch.Tensor:
    """Returns ``value``. TypeError or ValueError unless it is a tensor of the shape and dtype of
    ``like``, on its device. Does not synchronise.
    """
    fits = isinstance(value, torch.Tensor) and value.shape == like.shape
    if not fits or value.dtype != like.dtype or value.device != like.device or not is_stored(value):
        raise (ValueError if isinstance(value, torch.Tensor) else TypeError)(
            f"{name} must be a {like.dtype} tensor of shape {tuple(like.shape)} on {like.device}, "
            f"but {_described(value)} was given"
        )
    return value


def lanes(name: str, value: Any, n_lanes: int, device: torch.device) -> torch.Tensor:
    """Returns ``value``. TypeError or ValueError unless it is a tensor on ``device``, of any shape,
    with one integer per lane. Does not synchronise.
    """
    fits = isinstance(value, torch.Tensor) and value.numel() == n_lanes and value.device == device
    if not fits or value.dtype not in _INTEGERS or not is_stored(value):
        raise (ValueError if isinstance(value, torch.Tensor) else TypeError)(
            f"{name} must be a tensor of integers, one for each of the {n_lanes} lanes, on "
            f"{device}, but {_described(value)} was given"
        )
    return value


def vectors(name: str, value: Any, n_lanes: int, dim: int, device: torch.device) -> torch.Tensor:
    """Returns ``value``. TypeError or ValueError unless it is a float32 tensor on ``device`` with
    ``dim`` numbers per lane along its last axis. Does not synchronise.
    """
    fits = isinstance(value, torch.Tensor) and value.shape[-1:] == (dim,)
    if (
        not fits
        or value.numel() != n_lanes * dim
        or value.dtype != torch.float32
        or value.device != device
        or not is_stored(value)
    ):
        raise (ValueError if isinstance(value, torch.Tensor) else TypeError)(
            f"{name} must be a tensor of float32 numbers, {dim} for each of the {n_lanes} lanes, "
            f"on {device}, but {_described(value)} was given"
        )
    return value


def _sizes(shape) -> str:
    return ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")


def _described(value) -> str:
    """Describes a value in a few words."""
    if isinstance(value, torch.Tensor):
        if value.layout is not torch.strided:
            return f"a {value.layout} tensor"
        layout = "" if value.is_contiguous() else "non-contiguous "
        text = f"a {layout}{value.dtype} tensor of shape {tuple(value.shape)} on {value.device}"
        if value.is_neg():
            return f"{text} that is negated lazily (call resolve_neg)"
        if not is_stored(value):
            n_bytes = value.untyped_storage().nbytes()
            return f"{text} whose storage has only {n_bytes} bytes"
        return text
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"a {value.dtype} array of shape {tuple(value.shape)}"
    if value is None or isinstance(value, (bool, int, float, str)):
        return repr(value) if len(repr(value)) < 60 else f"a long {type(value).__name__}"
    return f"a {type(value).__name__}"
