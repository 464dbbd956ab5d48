"""Writers of mp4 and GIF, and the images they take."""

import io
import itertools
import os
import zlib
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["GifWriter", "Mp4Writer", "as_image"]

# x264's constant rate factor: 18 looks lossless, 23 is its default, thin coloured lines need more
QUALITY = "20"
MAX_PENDING = 4  # images that wait for the encoder
EXACT_COLOURS, GREYS = 64, 32  # of a GIF's palette


class Mp4Writer:
    """Encodes images into an mp4 in memory: h264 in yuv420p, which every player can show.

    A thread encodes, while the next image is drawn.

    Args:
        fps: frames per second.
    """

    container, codec, pixels = "mp4", "libx264", "yuv420p"
    options = {"crf": QUALITY, "preset": "veryfast"}

    def __init__(self, fps: float):
        import av  # which is needed for no other output

        self._from_array: Any = av.VideoFrame.from_ndarray
        self._buffer = io.BytesIO()
        self._container = av.open(self._buffer, "w", format=self.container)
        self._stream: Any = self._container.add_stream(
            self.codec, rate=Fraction(fps).limit_denominator(1000)
        )
        self._stream.pix_fmt = self.pixels
        self._stream.options = self.options
        self._shape = None
        self._thread = ThreadPoolExecutor(1)
        self._pending: deque[Future] = deque()

    def add(self, image: np.ndarray) -> None:
        """Adds a frame, (H, W, 3) uint8. Odd sizes are padded to even.

        Raises:
            ValueError: its size differs from the first frame's.
            Exception: an earlier one could not be encoded.
        """
        if self._shape is None:
            self._shape = image.shape
            self._stream.height, self._stream.width = (size + size % 2 for size in image.shape[:2])
        if image.shape != self._shape:
            raise ValueError(
                "all frames must have the size of the first, {1} x {0} pixels, "
                "but this one has {3} x {2}".format(*self._shape[:2], *image.shape[:2])
            )
        self._pending.append(self._thread.submit(self._add, image))
        self._wait(MAX_PENDING)

    def _wait(self, n_pending) -> None:
        while len(self._pending) > n_pending:
            self._pending.popleft().result()

    def _add(self, image) -> None:
        padding = [(0, size % 2) for size in image.shape[:2]]  # yuv420p halves both sides
        padded = np.pad(image, [*padding, (0, 0)], mode="edge")
        self._encode(self._from_array(padded, format="rgb24"))

    def _encode(self, frame) -> None:
        self._container.mux(self._stream.encode(frame))

    def close(self) -> bytes:
        """Returns the finished file, empty if there were no frames."""
        try:
            self._wait(0)
        finally:
            self._thread.shutdown(cancel_futures=True)
        if self._shape is None:
            return b""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        return self._buffer.getvalue()


def small_gif(path: str | os.PathLike, height: int, n_frames: int) -> tuple[bytes, tuple[int, int]]:
    """Returns a film as a GIF, and its height and width in pixels.

    Args:
        path: of an mp4 or GIF.
        height: the most pixels that its images are high.
        n_frames: the most frames, evenly spaced over the film, which takes as long as before.
    """
    import av

    with av.open(os.fspath(path)) as film:
        stream = film.streams.video[0]
        height = min(height, stream.height)
        size = height, max(1, round(stream.width * height / stream.height))
        every = max(1, -(-stream.frames // n_frames))
        writer = GifWriter(float(stream.average_rate or 10) / every)
        for frame in itertools.islice(film.decode(video=0), None, None, every):
            small = frame.reformat(width=size[1], height=size[0], format="rgb24")
            writer.add(small.to_ndarray())
    return writer.close(), size


class GifWriter(Mp4Writer):
    """Encodes images into a GIF in memory, with one palette of 256 colours."""

    container, codec, pixels = "gif", "gif", "pal8"
    options = {}

    def __init__(self, fps: float):
        super().__init__(fps)
        self._frames: list[bytes] = []  # compressed: the palette is known when all are there

    def _add(self, image) -> None:
        height, width = self._stream.height, self._stream.width
        padding = [(0, height - len(image)), (0, width - image.shape[1]), (0, 0)]
        self._frames.append(zlib.compress(np.pad(image, padding, mode="edge").tobytes(), 1))

    def close(self) -> bytes:
        """Returns the finished file, empty if there were no frames."""
        from PIL import Image

        self._wait(0)
        if self._frames:
            sample = [self._image(i) for i in np.linspace(0, len(self._frames) - 1, 12).astype(int)]
            colours = _palette(np.concatenate(sample))
            palette = Image.new("P", (1, 1))
            palette.putpalette(colours.ravel().tolist())
            argb = np.concatenate([np.full((256, 1), 255, np.uint8), colours], 1)
            exact = _packed(colours[:EXACT_COLOURS])
            order = np.argsort(exact)
            for i in range(len(self._frames)):
                image, packed = self._image(i), _packed(self._image(i))
                close = Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE)
                # Pillow takes a colour nearby even where there is the exact one
                nearest = order[np.searchsorted(exact[order], packed).clip(max=len(exact) - 1)]
                indices = np.where(exact[nearest] == packed, nearest, np.array(close))
                self._encode(self._from_array((indices.astype(np.uint8), argb), format="pal8"))
        return super().close()

    def _image(self, i) -> np.ndarray:
        content = np.frombuffer(zlib.decompress(self._frames[i]), np.uint8)
        return content.reshape(self._stream.height, self._stream.width, 3)


def _palette(image) -> np.ndarray:
    """Returns 256 colours, (256, 3) uint8: the most frequent ones of an image exactly, and what
    fits the others best.
    """
    from PIL import Image

    packed, counts = np.unique(_packed(image), return_counts=True)
    packed = packed[np.argsort(-counts)]
    colours = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], 1).astype(np.uint8)
    exact, rare = np.split(colours, [EXACT_COLOURS])
    if len(rare):
        fitted = Image.fromarray(rare[None]).quantize(256 - EXACT_COLOURS - GREYS)
        rare = np.array(fitted.getpalette(), np.uint8).reshape(-1, 3)
    greys = np.linspace(0, 255, GREYS).astype(np.uint8)[:, None].repeat(3, 1)  # of depth
    return np.concatenate([exact, greys, rare, np.zeros((256, 3), np.uint8)])[:256]


def _packed(image) -> np.ndarray:
    """Returns a number for each colour."""
    red, green, blue = np.moveaxis(image.astype(np.int32), -1, 0)
    return (red << 16) + (green << 8) + blue


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
