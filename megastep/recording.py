"""Records videos of environments. Worker processes draw the frames in parallel.

::

    with ParallelEncoder(env.plot_state) as encoder:
        world = env.reset()
        for _ in range(64):
            world = env.step(agent(world))
            encoder(env.state())
    encoder.save('video.mp4')
"""

from __future__ import annotations

import base64
import collections
import contextlib
import functools
import inspect
import os
import pathlib
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from megastep import workers
from megastep.arrdict import clone, numpyify
from megastep.types import Tree, n_lanes, optional
from megastep.video import Mp4Writer, as_image

if TYPE_CHECKING:
    from IPython.display import HTML  # pyright: ignore[reportMissingImports]
    from loky import ProcessPoolExecutor
    from typing_extensions import Self

    from megastep.types import Env, PolicyLike

__all__ = ["ParallelEncoder", "draw"]

MAX_WORKERS = 8  # about 80 figures per second; each imports torch, about half a gigabyte of memory


class ParallelEncoder:
    """Draws states as frames of a video, in the order in which they are given.

    Inside its ``with`` block, call it with a state, or :meth:`frame` with a finished image. After
    the block, use :meth:`save` or :meth:`notebook`.

    Args:
        plot_state: takes a numpyified state, returns a matplotlib figure or an (H, W, 3) uint8
            array. Functions, classmethods and staticmethods run in worker processes. A method of an
            object runs in this process, with a warning, because the whole object would have to be
            sent to the workers.
        fps: frames per second of the video.
        n_workers: number of worker processes; by default one per core, at most 8.

    Raises:
        RuntimeError: a frame could not be drawn; names the first such frame. Raised by any method.
    """

    def __init__(self, plot_state: Callable, fps: float = 20, n_workers: int | None = None):
        if not 0 < fps <= 1000:
            raise ValueError(
                f"fps must be more than 0 and at most 1000 frames per second, but {fps} was given"
            )
        if n_workers is not None and n_workers < 1:
            raise ValueError(f"n_workers must be at least 1, but {n_workers} was given")
        self._plot_state, self._pickled_plot_state = plot_state, _pickled(plot_state)
        self._fps, self._n_workers = fps, n_workers
        self._pool: ProcessPoolExecutor | None = None
        self._writer: Mp4Writer | None = None
        self._bytes: bytes | None = None
        self._pending = collections.deque()  # (frame number, image or future), oldest first

    def __enter__(self) -> ParallelEncoder:
        self._writer, self._bytes, self._n_frames = Mp4Writer(self._fps), None, 0
        return self

    def __call__(self, state: Tree) -> None:
        """Draws a state, a tree of tensors or arrays, as the next frame. The state is copied."""
        self._check_open()
        state = numpyify(clone(state))
        if self._pickled_plot_state is None:
            with _frame_errors(self._n_frames):
                self._add(draw(self._plot_state, state))
        else:
            with workers.terminal_signals_blocked():
                future = self._workers().submit(_draw_pickled, self._pickled_plot_state, state)
            self._add(future)

    def frame(self, array: ArrayLike) -> None:
        """Adds an image as the next frame: (H, W, 3), uint8 or floats in [0, 1].

        All frames must have the same size.
        """
        self._check_open()
        self._add(as_image(array))

    def __exit__(self, kind, error, trace) -> None:
        try:
            if kind is None:
                self._encode_until(0)
                self._close()
        finally:
            self._stop_workers(kill=bool(self._pending))
            if self._bytes is None:  # raise the error that ended the block, not one of closing
                with contextlib.suppress(Exception):
                    self._close()
            self._writer = None

    def _close(self) -> None:
        assert self._writer is not None
        self._bytes = self._writer.close()

    def save(self, path: str | os.PathLike) -> pathlib.Path:
        """Writes the video to ``path``, an mp4, and returns the path.

        Writes atomically: if it fails, an existing file is unchanged. Creates missing folders.
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
                os.chmod(file.name, 0o644)  # temporary files are readable by their owner only
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise
        return path

    def notebook(self) -> HTML:
        """Returns the video as an object that notebooks display."""
        video = self._finished()
        try:
            from IPython.display import HTML  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ImportError(
                "showing a video in a notebook needs IPython, which is not installed: pip install "
                "ipython, or save the video instead"
            ) from None
        return HTML(
            '<video controls autoplay loop muted src="data:video/mp4;base64,'
            f'{base64.b64encode(video).decode()}"></video>'
        )

    def _check_open(self) -> None:
        if self._writer is None:
            raise RuntimeError(
                "frames can only be added inside the with block: with ParallelEncoder(...) as "
                "encoder"
            )

    def _finished(self) -> bytes:
        if self._bytes is None:
            raise RuntimeError(
                "the video is finished when the with block ends: call save or notebook after it"
            )
        if not self._bytes:
            raise ValueError(
                "the video has no frames: call the encoder with a state inside the with block"
            )
        return self._bytes

    def _workers(self) -> ProcessPoolExecutor:
        """Returns the pool of worker processes, started at the first call."""
        if self._pool is None:
            import loky

            self._n_workers = self._n_workers or min(loky.cpu_count(), MAX_WORKERS)
            self._pool = loky.ProcessPoolExecutor(
                self._n_workers,
                initializer=workers.end_with_parent,
                initargs=(os.getpid(),),
                env=workers.WORKER_ENV,
            )
        return self._pool

    def _add(self, image: np.ndarray | Future) -> None:
        self._pending.append((self._n_frames, image))
        self._n_frames += 1
        self._encode_until(2 * (self._n_workers or 0) if self._pool else 0)

    def _encode_until(self, n_pending: int) -> None:
        """Encodes the oldest frames until ``n_pending`` are left, then those that are ready."""
        assert self._writer is not None
        while self._pending:
            number, image = self._pending[0]
            if len(self._pending) <= n_pending and not _is_ready(image):
                break
            with _frame_errors(number):
                self._writer.add(image if isinstance(image, np.ndarray) else image.result())
            self._pending.popleft()

    def _stop_workers(self, kill) -> None:
        self._pending.clear()
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=kill)
            self._pool = None


def _is_ready(image: np.ndarray | Future) -> bool:
    return isinstance(image, np.ndarray) or image.done()


class _frame_errors:
    """A context that adds the frame's number to an exception. Signals pass unchanged."""

    def __init__(self, number: int):
        self.number = number

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind, error, trace) -> None:
        if isinstance(error, Exception):
            first_line = next(iter(str(error).splitlines()), "")
            raise RuntimeError(
                f"frame {self.number} could not be recorded: {kind.__name__}: {first_line}"
            ) from error


# ---- Drawing ----


def _pickled(plot_state: Callable) -> bytes | None:
    """Returns ``plot_state`` as bytes for the workers. If it must stay in this process, warns and
    returns None.
    """
    function = plot_state
    while isinstance(function, functools.partial):
        function = function.func
    if inspect.ismethod(function) and not isinstance(function.__self__, type):
        reason = f"{function.__name__} is a method of a {type(function.__self__).__name__} object"
    else:
        import cloudpickle

        try:
            return cloudpickle.dumps(plot_state)
        except Exception as error:
            reason = (
                f"plot_state cannot be sent to another process ({type(error).__name__}: {error})"
            )
    warnings.warn(
        f"{reason}, so frames are drawn in this process, one by one. Use a classmethod, a "
        "staticmethod or a function of a module to draw in parallel",
        stacklevel=3,
    )
    return None


@functools.lru_cache(1)
def _unpickled(pickled: bytes) -> Callable:
    import cloudpickle

    return cloudpickle.loads(pickled)


def _draw_pickled(pickled: bytes, state: Tree) -> np.ndarray:
    """Draws a state in a worker process."""
    return draw(_unpickled(pickled), state)


def draw(plot_state: Callable, state: Tree) -> np.ndarray:
    """Returns what ``plot_state`` draws of a numpyified state, as (H, W, 3) uint8.

    Closes the figure if pyplot knows it.
    """
    drawing = plot_state(state)
    if isinstance(drawing, np.ndarray):
        return as_image(drawing)
    if not hasattr(drawing, "savefig"):
        raise TypeError(
            "plot_state must return a matplotlib figure or an array, but it returned a "
            f"{type(drawing).__name__}"
        )
    from megastep import plotting

    try:
        return plotting.rasterise(drawing)
    finally:
        if "matplotlib.pyplot" in sys.modules:
            sys.modules["matplotlib.pyplot"].close(drawing)


@torch.no_grad()
def film(
    env: Env,
    policy: PolicyLike,
    path: str | pathlib.Path,
    steps: int,
    greedy: bool = False,
    seed: int = 1,
) -> pathlib.Path:
    """Films environment 0 of `env` for some steps from its reset, each a frame, at the
    environment's own frames per second. Returns the path.

    Args:
        path: an .mp4, or a .png, which is the last frame.

    Raises:
        ValueError: for another kind of file, or an environment that cannot be drawn.
        OSError: the file cannot be written.
        RuntimeError: naming the first frame that failed.
    """
    plot_state = getattr(env, "plot_state", None)
    if plot_state is None or not hasattr(env, "state"):
        raise ValueError(
            f"{type(env).__name__} cannot be drawn: it needs the methods state(e) and "
            "plot_state(state), which docs/new-environment.md shows"
        )
    path = pathlib.Path(path)
    if path.suffix not in (".mp4", ".png"):
        raise ValueError(f"'{path}' is neither a video, .mp4, nor its last frame, .png")
    if path.is_dir():
        raise ValueError(f"{path} is a folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=path.parent).close()  # an error now, not when all is drawn
    states = _states(env, policy, steps, greedy, seed)
    if path.suffix == ".png":
        from matplotlib.image import imsave  # a third of a second, which train.py needs not wait

        (last,) = collections.deque(states, maxlen=1)
        imsave(path, draw(plot_state, numpyify(last)))
        return path
    with ParallelEncoder(plot_state, fps=optional(env, "fps")) as encoder:
        for state in states:
            encoder(state)
    return encoder.save(path)


def _states(env: Any, policy, steps, greedy, seed) -> Iterator[dict]:
    world, hidden = env.reset(), policy.initial(n_lanes(env), env.device)
    generator = torch.Generator(env.device).manual_seed(seed)
    yield env.state(0)
    for _ in range(steps - 1):
        decision, hidden = policy(world, hidden, sample=not greedy, generator=generator)
        world = env.step(decision)
        yield env.state(0)
