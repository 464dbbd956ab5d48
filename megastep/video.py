"""Writers of mp4 and GIF, and the images they take."""

import io
import itertools
import math
import os
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

__all__ = ["WRITERS", "GifWriter", "Mp4Writer", "as_image", "small_gif"]

# x264's constant rate factor: 18 looks lossless, 23 is its default, thin coloured lines need more
QUALITY = "20"


class Mp4Writer:
    """Encodes images into an mp4 in memory: h264 in yuv420p, which every player can show. A
    thread encodes while the next image is drawn.
    """

    def __init__(self, fps: float):
        import av  # which is needed for no other output

        self._from_array: Any = av.VideoFrame.from_ndarray
        self._buffer = io.BytesIO()
        self._container = av.open(self._buffer, "w", format="mp4")
        rate = Fraction(fps).limit_denominator(1000)
        self._stream: Any = self._container.add_stream("libx264", rate=rate)
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": QUALITY, "preset": "veryfast"}
        self._thread, self._last = ThreadPoolExecutor(1), None

    def add(self, image: np.ndarray) -> None:
        """Adds a frame, (H, W, 3) uint8. Odd sizes are padded to even."""
        padding = [(0, size % 2) for size in image.shape[:2]]  # yuv420p halves both sides
        padded = np.pad(image, [*padding, (0, 0)], mode="edge")
        if self._last is None:
            self._stream.height, self._stream.width = padded.shape[:2]
        else:
            self._last.result()
        self._last = self._thread.submit(self._encode, padded)

    def _encode(self, image) -> None:
        self._container.mux(self._stream.encode(self._from_array(image, format="rgb24")))

    def close(self) -> bytes:
        """Returns the finished file, empty if there were no frames."""
        self._thread.shutdown()
        if self._last is None:
            return b""
        self._last.result()
        self._container.mux(self._stream.encode(None))
        self._container.close()
        return self._buffer.getvalue()


class GifWriter:
    """Encodes images into a GIF in memory, with a palette of 256 colours each. A GIF counts in
    hundredths of a second, so some frames are shown for longer than others.
    """

    def __init__(self, fps: float):
        self._fps, self._frames = fps, []

    def add(self, image: np.ndarray) -> None:
        """Adds a frame, (H, W, 3) uint8."""
        method, dither = Image.Quantize.FASTOCTREE, Image.Dither.NONE
        self._frames.append(Image.fromarray(image).quantize(256, method, dither=dither))

    def close(self) -> bytes:
        """Returns the finished file, empty if there were no frames."""
        if not self._frames:
            return b""
        first, *others = self._frames
        ends = np.round(np.arange(len(self._frames) + 1) * 100 / self._fps)
        first.save(
            buffer := io.BytesIO(),
            "GIF",
            save_all=True,
            append_images=others,
            duration=(10 * np.diff(ends)).astype(int).tolist(),  # of hundredths of a second
            loop=0,
            optimize=False,
        )
        return buffer.getvalue()


#: Of each format, what encodes it and the most frames per second. Browsers show frames of a GIF of
#: one hundredth of a second for ten; no screen shows more than an mp4's.
WRITERS = {"mp4": (Mp4Writer, 120), "gif": (GifWriter, 50)}


def small_gif(path: str | os.PathLike, height: int, n_frames: int) -> tuple[bytes, tuple[int, int]]:
    """Returns an mp4 or GIF as a GIF of at most so many pixels in height and frames, evenly
    spaced, which takes as long as before; and its height and width.
    """
    import av

    with av.open(os.fspath(path)) as film:
        stream = film.streams.video[0]
        height = min(height, stream.height)
        size = height, max(1, round(stream.width * height / stream.height))
        fps = float(stream.average_rate or 10)
        every = max(1, math.ceil(stream.frames / n_frames), math.ceil(fps / WRITERS["gif"][1]))
        writer = GifWriter(fps / every)
        for frame in itertools.islice(film.decode(video=0), None, None, every):
            small = frame.reformat(width=size[1], height=size[0], format="rgb24")
            writer.add(small.to_ndarray())
    return writer.close(), size


def as_image(array: ArrayLike) -> np.ndarray:
    """Returns a copy of an image, uint8 or floats in [0, 1], as (H, W, 3) uint8. Raises ValueError
    for another shape or dtype.
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
