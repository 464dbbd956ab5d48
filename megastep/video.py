"""Writers of mp4 and GIF, and the images they take."""

import io
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["GifWriter", "Mp4Writer", "as_image"]

# x264's constant rate factor: 18 looks lossless, 23 is its default, thin coloured lines need more
QUALITY = "20"


class Mp4Writer:
    """Encodes images into an mp4 in memory: h264 in yuv420p, which every player can show.

    Args:
        fps: frames per second.
    """

    container, codec, pixels = "mp4", "libx264", "yuv420p"
    options = {"crf": QUALITY, "preset": "veryfast"}  # noqa: RUF012

    def __init__(self, fps: float):
        import av  # which is needed for no other output

        self._from_array = av.VideoFrame.from_ndarray
        self._buffer = io.BytesIO()
        self._container = av.open(self._buffer, "w", format=self.container)
        self._stream: Any = self._container.add_stream(
            self.codec, rate=Fraction(fps).limit_denominator(1000)
        )
        self._stream.pix_fmt = self.pixels
        self._stream.options = self.options
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
        self._container.mux(self._stream.encode(self._frame(image)))

    def _frame(self, image):
        padding = [(0, size % 2) for size in image.shape[:2]]  # yuv420p halves both sides
        padded = np.pad(image, [*padding, (0, 0)], mode="edge")
        return self._from_array(padded, format="rgb24")

    def close(self) -> bytes:
        """Returns the finished file, empty if there were no frames."""
        if self._shape is None:
            return b""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        return self._buffer.getvalue()


class GifWriter(Mp4Writer):
    """Encodes images into a GIF in memory. Its palette is the colours of the first frame, and a
    cube of 125 for those that come later.
    """

    container, codec, pixels = "gif", "gif", "pal8"
    options = {}  # noqa: RUF012

    def __init__(self, fps: float):
        super().__init__(fps)
        self._palette: Any = None

    def _frame(self, image):
        from PIL import Image

        height, width = (size + size % 2 for size in image.shape[:2])
        padded = np.pad(
            image, [(0, height - len(image)), (0, width - image.shape[1]), (0, 0)], mode="edge"
        )
        if self._palette is None:
            of_first = Image.fromarray(padded).quantize(128, dither=Image.Dither.NONE)
            levels = np.linspace(0, 255, 5).astype(np.uint8)
            cube = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(-1)
            colours = [*(of_first.getpalette() or [])[: 3 * 128], *cube.tolist()]
            self._palette = Image.new("P", (1, 1))
            self._palette.putpalette(colours)
            rgb = np.zeros((256, 3), np.uint8)
            rgb[: len(colours) // 3] = np.reshape(colours, (-1, 3))
            self._argb = np.concatenate([np.full((256, 1), 255, np.uint8), rgb], 1)
        indices = Image.fromarray(padded).quantize(
            palette=self._palette, dither=Image.Dither.NONE
        )
        return self._from_array((np.array(indices), self._argb), format="pal8")


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
