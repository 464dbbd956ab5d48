"""Checks of arguments. Their errors name the argument, what is allowed and what was given."""

import math
import numbers
import operator
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn, TypeVar, cast

import torch

from megastep.coefficients import on_device
from megastep.ragged import Ragged, RaggedTorch
from megastep.read_only import ReadOnlyTensor

T = TypeVar("T")

_INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
LIMIT = 1e9  # of numbers that kernels compute with: a product of four still fits into float32


def _refuse(name, wanted, value, kind: type[Exception] = ValueError) -> NoReturn:
    raise kind(f"{name} must be {wanted}, but {_described(value)} was given")


# ---- Values ----


def integer(name: str, value: object, min: int, max: float = math.inf) -> int:
    """Returns ``value`` as an int. ValueError unless it is an integer from ``min`` to ``max``."""
    number = value if type(value) is int else _index(value)
    if number is None or not min <= number <= max:
        range_ = f"from {min} to {max}" if max < math.inf else f"of at least {min}"
        _refuse(name, f"an integer {range_}", value)
    return number


def _index(value) -> int | None:
    """Returns a value as an int, or None if it is none."""
    try:
        return None if isinstance(value, bool) else operator.index(value)
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
        _refuse(name, f"{kind} {range_}{hint}", value)
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
    """Returns ``value`` as a contiguous float32 tensor on ``device``.

    Args:
        shape: sizes; a string stands for any size.

    Raises:
        ValueError: unless it is an array of that shape whose numbers are below 1e9.
    """
    try:
        tensor = value if isinstance(value, torch.Tensor) else torch.as_tensor(value)
        tensor = tensor.clone() if isinstance(tensor, ReadOnlyTensor) else tensor
        is_real = not tensor.is_complex() and tensor.layout is torch.strided
        is_real &= not tensor.is_meta
        tensor = tensor.to(device=device, dtype=torch.float32) if is_real else None
    except (TypeError, ValueError, RuntimeError, NotImplementedError):
        tensor = None
    if tensor is None or not _fits(tensor, shape):
        _refuse(name, f"an array of numbers of shape ({_sizes(shape)})", value)
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
        is_integer = tensor.dtype in _INTEGERS or not tensor.numel()
        tensor = tensor.clone().to(device=device, dtype=torch.int64) if is_integer else None
    except (TypeError, ValueError, RuntimeError, NotImplementedError):
        tensor = None
    if tensor is None or not _fits(tensor, (size,)):
        _refuse(name, f"an array of integers of shape ({size},)", value)
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
    """Returns a Ragged with vals (*shape) as a RaggedTorch on ``device``.

    Raises:
        TypeError: unless it is a Ragged.
        ValueError: unless its vals pass :func:`floats`.
    """
    if not isinstance(value, Ragged) and not hasattr(value, "torchify"):
        _refuse(name, "a Ragged", value, TypeError)
    value = cast("RaggedTorch", value).torchify()
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
    name: str, value: Any, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> int:
    """Returns a tensor's address.

    Raises:
        TypeError: unless it is a tensor.
        ValueError: unless it is contiguous, on ``device``, of that shape and dtype.
    """
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


def addresses(
    shape: tuple[int, ...], dtype: torch.dtype, device: torch.device, **tensors: Any
) -> dict[str, int]:
    """Returns {name: :func:`address`} of tensors that are alike."""
    return {name: address(name, one, shape, dtype, device) for name, one in tensors.items()}


def optional(
    name: str, value: Any, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> int:
    """Returns a tensor's :func:`address`, or 0 for None: a null pointer."""
    return 0 if value is None else address(name, value, shape, dtype, device)


def alike(name: str, value: Any, like: torch.Tensor) -> torch.Tensor:
    """Returns ``value``. TypeError or ValueError unless it is a tensor of the shape and dtype of
    ``like``, on its device.
    """
    fits = isinstance(value, torch.Tensor) and value.shape == like.shape
    if not fits or value.dtype != like.dtype or value.device != like.device:
        wanted = f"a {like.dtype} tensor of shape {tuple(like.shape)} on {like.device}"
        _refuse_tensor(name, wanted, value)
    return value


def lanes(name: str, value: Any, n_lanes: int, device: torch.device) -> torch.Tensor:
    """Returns ``value``. TypeError or ValueError unless it is a tensor on ``device``, of any shape,
    with one integer per lane.
    """
    fits = isinstance(value, torch.Tensor) and value.numel() == n_lanes and value.device == device
    if not fits or value.dtype not in _INTEGERS:
        wanted = f"a tensor of integers, one for each of the {n_lanes} lanes, on {device}"
        _refuse_tensor(name, wanted, value)
    return value


def vectors(name: str, value: Any, n_lanes: int, dim: int, device: torch.device) -> torch.Tensor:
    """Returns ``value``. TypeError or ValueError unless it is a float32 tensor on ``device`` with
    ``dim`` numbers per lane along its last axis.
    """
    fits = isinstance(value, torch.Tensor) and value.shape[-1:] == (dim,)
    fits = fits and value.numel() == n_lanes * dim and value.device == device
    if not fits or value.dtype != torch.float32:
        wanted = f"a tensor of float32 numbers, {dim} for each of the {n_lanes} lanes, on {device}"
        _refuse_tensor(name, wanted, value)
    return value


def _refuse_tensor(name, wanted, value) -> NoReturn:
    _refuse(name, wanted, value, ValueError if isinstance(value, torch.Tensor) else TypeError)


# ---- Words ----


def _sizes(shape) -> str:
    return ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")


def _described(value) -> str:
    """Describes a value in a few words."""
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
