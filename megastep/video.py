"""An mp4 writer, and the images it takes."""

import io
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["Mp4Writer", "as_image"]

# x264's constant rate factor: 18 looks lossless, 23 is its default, thin coloured lines need more
QUALITY = "20"


class Mp4Writer:
    """Encodes images into an mp4 in memory: h264 in yuv420p, which every player can show.

    Args:
        fps: frames per second.
    """

    def __init__(self, fps: float):
        import av  # which is needed for no other output

        self._from_array = av.VideoFrame.from_ndarray
        self._buffer = io.BytesIO()
        self._container = av.open(self._buffer, "w", format="mp4")
        self._stream = self._container.add_stream(
            "libx264", rate=Fraction(fps).limit_denominator(1000)
        )
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": QUALITY, "preset": "veryfast"}
        self._shape = None

    def add(self, image: np.ndarray) -> None:
        """Adds a frame, (H, W, 3) uint8. Odd sizes are padded to even.

        Raises:
            ValueError: its size differs from the first frame's.
        """
        if self._shape is None:
            self._shape = image.shape
            self._stream.height, self._stream.width = (size + size % 2 for size in image.shape[:2])
        if image.shape != self._shape:
            raise ValueError(
                "all frames must have the size of the first, {1} x {0} pixels, "
                "but this one has {3} x {2}".format(*self._shape[:2], *image.shape[:2])
            )
        padding = [(0, size % 2) for size in image.shape[:2]]  # yuv420p halves both sides
        padded = np.pad(image, [*padding, (0, 0)], mode="edge")
        self._container.mux(self._stream.encode(self._from_array(padded, format="rgb24")))

    def close(self) -> bytes:
        """Returns the finished file, empty if there were no frames."""
        if self._shape is None:
            return b""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        return self._buffer.getvalue()


def as_image(array: ArrayLike) -> np.ndarray:
    """Returns a copy of an image, uint8 or floats in [0, 1], as (H, W, 3) uint8.

    Raises:
        ValueError: it has another shape or dtype.
    """
    array = np.asarray(array)
    if array.ndim != 3 or array.shape[-1] != 3 or not array.size:
        raise ValueError(f"a frame must have shape (H, W, 3), but this one has {array.shape}")
    if np.issubdtype(array.dtype, np.floating):
        return (255 * np.clip(np.nan_to_num(array), 0, 1) + 0.5).astype(np.uint8)
    if array.dtype != np.uint8:
        raise ValueError(
            f"a frame must hold uint8 or floats from 0 to 1, but this one holds {array.dtype}"
        )
    return array.copy()
