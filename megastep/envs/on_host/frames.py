"""Frames that environments of other packages render, as images."""

import numpy as np

__all__ = ["as_frame"]

#: A float frame with a larger number counts from 0 to 255; rounding may exceed 1 a little.
MAX_FRACTION = 1.5


def as_frame(rendered: object) -> np.ndarray:
    """Returns a rendered frame as (H, W, 3) uint8.

    Args:
        rendered: (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), of which the last channel is left out;
            uint8, other integers or floats from 0 to 255, or floats from 0 to 1.

    Raises:
        ValueError: it is none of these.
    """
    frame = np.asarray(rendered)
    frame = frame[..., None] if frame.ndim == 2 else frame
    is_number = np.issubdtype(frame.dtype, np.number) or frame.dtype == bool
    if frame.ndim != 3 or frame.shape[-1] not in (1, 3, 4) or not is_number or not frame.size:
        raise ValueError(
            f"render() returned {_described(rendered, frame)}, not an image of shape (H, W, 3)"
        )
    if frame.dtype != np.uint8:
        is_fraction = not np.issubdtype(frame.dtype, np.integer) and frame.max() <= MAX_FRACTION
        frame = np.nan_to_num(frame.astype(np.float64)) * (255 if is_fraction else 1)
        if frame.min() < -0.5 or frame.max() > (MAX_FRACTION * 255 if is_fraction else 255.5):
            raise ValueError(
                f"render() returned numbers from {frame.min():g} to {frame.max():g}; an image has "
                "uint8, or floats from 0 to 1 or 0 to 255"
            )
        frame = np.clip(np.rint(frame), 0, 255).astype(np.uint8)
    frame = frame[..., :3]
    return np.array(np.broadcast_to(frame, (*frame.shape[:2], 3)))


def _described(rendered, frame) -> str:
    if frame.dtype == object:
        return "None" if rendered is None else f"a {type(rendered).__name__}"
    return f"{frame.dtype} of shape {frame.shape}"
