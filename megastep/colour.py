"""Conversion between linear light, which the engine computes in, and sRGB, which screens expect
(IEC 61966-2-1).
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch

#: Values in [0, 1], of any shape.
Values = TypeVar("Values", np.ndarray, torch.Tensor)

_KNEE = 0.0031308  # linear light below which sRGB is a straight line
_SLOPE, _SCALE, _POWER = 12.92, 1.055, 2.4


def gamma_encode(light: Values) -> Values:
    """Returns the sRGB values of linear light. Images must be encoded before they are shown."""
    x, above, where = _above(light, _KNEE)
    return where(x <= _KNEE, _SLOPE * x, _SCALE * above ** (1 / _POWER) - (_SCALE - 1))


def gamma_decode(values: Values) -> Values:
    """Returns the linear light of sRGB values: the inverse of :func:`gamma_encode`."""
    x, above, where = _above(values, _SLOPE * _KNEE)
    curve = ((above + (_SCALE - 1)) / _SCALE) ** _POWER
    return where(x <= _SLOPE * _KNEE, x / _SLOPE, curve)


def _above(x, knee: float) -> tuple[Any, Any, Callable]:
    """Returns ``x`` in floats, the same but no less than the knee, and its library's ``where``."""
    if isinstance(x, torch.Tensor):
        x = x if x.is_floating_point() else x.float()
        return x, x.clamp(min=knee), torch.where
    x = np.asarray(x)
    x = x if np.issubdtype(x.dtype, np.floating) else x.astype(float)
    return x, np.maximum(x, x.dtype.type(knee)), np.where
