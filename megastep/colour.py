"""Conversion between linear light, in which the engine calculates, and the sRGB values that screens
expect (IEC 61966-2-1).
"""

import numpy as np
import torch

Light = np.ndarray | torch.Tensor

_KNEE = 0.0031308  # linear light below which sRGB is a straight line
_SLOPE, _SCALE, _POWER = 12.92, 1.055, 2.4


def gamma_encode(light: Light) -> Light:
    """sRGB values of linear light, both in [0, 1]: what an image must go through before it is
    shown. Any shape.
    """
    return _pieces(
        light, _KNEE, lambda x: _SLOPE * x, lambda x: _SCALE * x ** (1 / _POWER) - (_SCALE - 1)
    )


def gamma_decode(values: Light) -> Light:
    """Linear light of sRGB values: the inverse of :func:`gamma_encode`."""
    return _pieces(
        values,
        _SLOPE * _KNEE,
        lambda x: x / _SLOPE,
        lambda x: ((x + (_SCALE - 1)) / _SCALE) ** _POWER,
    )


def _pieces(x, knee, line, curve):
    """``line(x)`` up to the knee and ``curve(x)`` beyond it, in the floating dtype of ``x``."""
    if isinstance(x, torch.Tensor):
        x = x if x.is_floating_point() else x.float()
        return torch.where(x <= knee, line(x), curve(x.clamp(min=knee)))
    x = np.asarray(x)
    x = x if np.issubdtype(x.dtype, np.floating) else x.astype(float)
    return np.where(x <= knee, line(x), curve(np.maximum(x, x.dtype.type(knee))))
