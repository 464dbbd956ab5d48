"""Videos of environments: figures drawn in worker processes, encoded as they come.

::

    with ParallelEncoder(env.plot_state) as encoder:
        world = env.reset()
        for _ in range(64):
            world = env.step(agent(world))
            encoder(env.state())
    encoder.save('video.mp4')
"""

import base64
import collections
import contextlib
import functools
import inspect
import io
import os
import pathlib
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from megastep import workers
from megastep.arrdict import clone, numpyify

__all__ = ["ParallelEncoder", "draw"]

MAX_WORKERS = 8  # some 80 figures per second; each has torch in memory, about half a gigabyte
# x264's constant rate factor: 18 looks lossless, 23 is its default, thin coloured lines need more
QUALITY = "20"


class ParallelEncoder:
    """Turns states into frames and frames into a video, in the order in which they were given.

    Args:
        plot_state: takes a numpyified state, returns a matplotlib figure or an (H, W, 3) uint8
            array. Functions, classmethods and staticmethods run in worker processes. A method of an
            object would drag the object along, so it is called in this process, with a warning.
        fps: frames per second of the video.
        n_workers: how many processes draw; by default as many as there are cores, 8 at most.

    Inside its ``with`` block, call it with a state, or :meth:`frame` with a finished image; after
    the block, use :meth:`save` or :meth:`notebook`. RuntimeError, from any of them, names the first
    frame that could not be drawn; KeyboardInterrupt and its like pass as they are.
    """

    def __init__(self, plot_state: Callable, fps: float = 20, n_workers: int | None = None):
        if not 0 < fps <= 1000:
            raise ValueError(
                f"fps must be more than 0 and at most 1000 frames per second, but {fps} was given"
            )
        if n_workers is not None and n_workers < 1:
            raise ValueError(f"n_workers must be at least 1, but {n_workers} was given")
        self._plot_state, self._payload = plot_state, _payload(plot_state)
        self._fps, self._n_workers = fps, n_workers
        self._pool = self._video = self._bytes = None
        self._pending = collections.deque()  # (number, future or array), oldest first

    def __enter__(self) -> "ParallelEncoder":
        self._video, self._bytes, self._n_frames = _Video(self._fps), None, 0
        return self

    def __call__(self, state: Any) -> None:
        """Draws a tree of tensors or arrays as the next frame; it is copied, so it may change
        afterwards.
        """
        self._check_open()
        state = numpyify(clone(state))
        if self._payload is None:
            with _named(self._n_frames):
                self._add(draw(self._plot_state, state))
        else:
            with _keep_from_terminal():
                drawn = self._workers().submit(_draw_payload, self._payload, state)
            self._add(drawn)

    def frame(self, array: ArrayLike) -> None:
        """Adds an image as the next frame: (H, W, 3), uint8 or floats from 0 to 1, of the same
        size as the others.
        """
        self._check_open()
        self._add(_image(array))

    def __exit__(self, kind, error, trace):
        try:
            if kind is None:
                self._drain(0)
                self._bytes = self._video.close()
        finally:
            self._stop(kill=bool(self._pending))
            if self._bytes is None:  # the error that ended the block matters more than one of this
                with contextlib.suppress(Exception):
                    self._bytes = self._video.close()
            self._video = None

    def save(self, path: str | os.PathLike) -> pathlib.Path:
        """Writes the video to ``path``, an mp4, whole or not at all; folders are made as needed.
        Returns the path.
        """
        video, path = self._finished(), pathlib.Path(path)
        if path.suffix != ".mp4":
            raise ValueError(
                f"videos are mp4 files, but '{path}' was given: use {path.with_suffix('.mp4').name}"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            dir=path.parent, prefix=f".{path.stem}-", suffix=".tmp", delete=False
        ) as file:
            try:
                file.write(video)
                file.flush()
                os.fsync(file.fileno())
                os.chmod(file.name, 0o644)  # temporary files are private, videos need not be
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise
        return path

    def notebook(self) -> Any:
        """The video as an object that a notebook shows."""
        video = self._finished()
        try:
            from IPython.display import HTML
        except ImportError:
            raise ImportError(
                "showing a video in a notebook needs IPython, which is not installed: pip install "
                "ipython, or save the video instead"
            ) from None
        return HTML(
            '<video controls autoplay loop muted src="data:video/mp4;base64,'
            f'{base64.b64encode(video).decode()}"></video>'
        )

    def _check_open(self):
        if self._video is None:
            raise RuntimeError(
                "frames are taken inside the encoder's with block: with ParallelEncoder(...) as e"
            )

    def _finished(self):
        if self._bytes is None:
            raise RuntimeError(
                "the video is finished when the encoder's with block ends: use it after the block"
            )
        if not self._bytes:
            raise ValueError(
                "no frames were recorded, so there is no video: call the encoder with a state first"
            )
        return self._bytes

    def _workers(self):
        if self._pool is None:
            import loky

            self._n_workers = self._n_workers or min(loky.cpu_count(), MAX_WORKERS)
            self._pool = loky.ProcessPoolExecutor(self._n_workers, env=workers.ENV)
        return self._pool

    def _add(self, source):
        self._pending.append((self._n_frames, source))
        self._n_frames += 1
        self._drain(2 * self._n_workers if self._pool else 0)

    def _drain(self, n_left):
        """Encodes the oldest frames until ``n_left`` are left in flight, and then those that are
        drawn already.
        """
        while self._pending and (len(self._pending) > n_left or _is_done(self._pending[0][1])):
            number, source = self._pending[0]
            with _named(number):
                self._video.add(source if isinstance(source, np.ndarray) else source.result())
            self._pending.popleft()

    def _stop(self, kill):
        self._pending.clear()
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=kill)
            self._pool = None


class _Video:
    """An mp4 in memory: h264 in yuv420p, which every player knows."""

    def __init__(self, fps):
        try:
            import av
        except ImportError:
            raise ImportError(
                "recording videos needs PyAV, which is not installed: pip install av"
            ) from None
        self._from_array = av.VideoFrame.from_ndarray
        self._buffer = io.BytesIO()
        self._container = av.open(self._buffer, "w", format="mp4")
        self._stream = self._container.add_stream(
            "libx264", rate=Fraction(fps).limit_denominator(1000)
        )
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": QUALITY, "preset": "veryfast"}
        self._shape = None

    def add(self, array):
        if self._shape is None:
            self._shape = array.shape
            self._stream.height, self._stream.width = (size + size % 2 for size in array.shape[:2])
        if array.shape != self._shape:
            raise ValueError(
                "all frames must have the size of the first, {1} x {0} pixels, "
                "but this one has {3} x {2}".format(*self._shape[:2], *array.shape[:2])
            )
        odd = [(0, size % 2) for size in array.shape[:2]]  # yuv420p halves both sides
        frame = self._from_array(np.pad(array, [*odd, (0, 0)], mode="edge"), format="rgb24")
        self._container.mux(self._stream.encode(frame))

    def close(self):
        """The finished file as bytes; empty if there were no frames."""
        if self._shape is None:
            return b""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        return self._buffer.getvalue()


class _named:
    """Names the frame in an exception that kept it from the video."""

    def __init__(self, number):
        self.number = number

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if isinstance(error, Exception):
            said = next(iter(str(error).splitlines()), "")
            raise RuntimeError(
                f"frame {self.number} could not be recorded: {kind.__name__}: {said}"
            ) from error


def _payload(plot_state):
    """``plot_state`` as bytes for the workers, or None, with a warning, if it has to stay in this
    process.
    """
    function = plot_state
    while isinstance(function, functools.partial):
        function = function.func
    if inspect.ismethod(function) and not isinstance(function.__self__, type):
        why = f"{function.__name__} is a method of a {type(function.__self__).__name__} object"
    else:
        import cloudpickle

        try:
            return cloudpickle.dumps(plot_state)
        except Exception as error:
            why = f"plot_state cannot be sent to another process ({type(error).__name__}: {error})"
    warnings.warn(
        f"{why}, so frames are drawn in this process, one by one; a classmethod, a staticmethod "
        f"or a "
        "function of a module would be drawn in parallel",
        stacklevel=3,
    )
    return None


@contextlib.contextmanager
def _keep_from_terminal():
    """Processes that start meanwhile, and theirs, never get what a terminal sends to all it has,
    Ctrl-C and SIGHUP: the one that owns the workers ends them.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _is_done(source):
    return isinstance(source, np.ndarray) or source.done()


def _image(array):
    """An (H, W, 3) uint8 array of a uint8 or float one; ValueError for anything else."""
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


# ---- In the workers ----


@functools.lru_cache(1)
def _unpickled(payload):
    import cloudpickle

    return cloudpickle.loads(payload)


def _draw_payload(payload, state):
    return draw(_unpickled(payload), state)


def draw(plot_state: Callable, state: Any) -> np.ndarray:
    """(H, W, 3) uint8: what ``plot_state`` draws of a numpyified state."""
    drawn = plot_state(state)
    if isinstance(drawn, np.ndarray):
        return _image(drawn)
    if not hasattr(drawn, "savefig"):
        raise TypeError(
            f"plot_state must return a matplotlib figure or an array, but it returned a "
            f"{type(drawn).__name__}"
        )
    from megastep import plotting

    try:
        return plotting.rasterise(drawn)
    finally:
        if "matplotlib.pyplot" in sys.modules:
            sys.modules["matplotlib.pyplot"].close(drawn)
