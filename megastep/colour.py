"""Conversion between linear light, which the engine computes in, and sRGB, which screens expect
(IEC 61966-2-1).
"""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch

#: Values in [0, 1], of any shape.
Values = TypeVar("Values", np.ndarray, torch.Tensor)

_KNEE = 0.0031308  # linear light below which sRGB is a straight line
_SLOPE, _SCALE, _POWER = 12.92, 1.055, 2.4


def gamma_encode(light: Values) -> Values:
    """Returns the sRGB values of linear light. Images must be encoded before they are shown."""
    return _piecewise(
        light, _KNEE, lambda x: _SLOPE * x, lambda x: _SCALE * x ** (1 / _POWER) - (_SCALE - 1)
    )


def gamma_decode(values: Values) -> Values:
    """Returns the linear light of sRGB values: the inverse of :func:`gamma_encode`."""
    return _piecewise(
        values,
        _SLOPE * _KNEE,
        lambda x: x / _SLOPE,
        lambda x: ((x + (_SCALE - 1)) / _SCALE) ** _POWER,
    )


def _piecewise(x: Values, knee: float, line: Callable, curve: Callable) -> Values:
    """Returns ``line(x)`` up to the knee and ``curve(x)`` above it, in the float dtype of ``x``."""
    if isinstance(x, torch.Tensor):
        x = x if x.is_floating_point() else x.float()
        return torch.where(x <= knee, line(x), curve(x.clamp(min=knee)))
    x = np.asarray(x)
    x = x if np.issubdtype(x.dtype, np.floating) else x.astype(float)
    return np.where(x <= knee, line(x), curve(np.maximum(x, x.dtype.type(knee))))
