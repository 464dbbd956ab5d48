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
import importlib
import inspect
import itertools
import os
import pathlib
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike

from megastep import plotting, workers
from megastep.arrdict import clone, numpyify
from megastep.atomic_files import write_atomically
from megastep.moments import film_moments
from megastep.types import Tree, optional
from megastep.video import GifWriter, Mp4Writer, as_image

if TYPE_CHECKING:
    from IPython.display import HTML  # pyright: ignore[reportMissingImports]
    from loky import ProcessPoolExecutor

    from megastep.types import Env, PolicyLike

__all__ = ["Film", "ParallelEncoder", "Player", "draw", "film", "film_all"]

MAX_WORKERS = 8  # about 80 figures per second; each imports torch, about half a gigabyte of memory

WRITERS = {"mp4": Mp4Writer, "gif": GifWriter}
VIDEO, IMAGE = "<video controls autoplay loop muted {}></video>", "<img {}>"
ENDINGS = {  # of films and pictures: their types, and how pages show them
    ".mp4": ("video/mp4", VIDEO),
    ".gif": ("image/gif", IMAGE),
    ".png": ("image/png", IMAGE),
    ".svg": ("image/svg+xml", IMAGE),
    ".pdf": ("application/pdf", '<embed width="100%" height="720" {}>'),
}


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
        format: mp4 or gif.

    Raises:
        RuntimeError: a frame could not be drawn; names the first such frame. Raised by any method.
    """

    def __init__(
        self,
        plot_state: Callable,
        fps: float = 20,
        n_workers: int | None = None,
        format: str = "mp4",
    ):
        if not 0 < fps <= 1000:
            raise ValueError(
                f"fps must be more than 0 and at most 1000 frames per second, but {fps} was given"
            )
        if n_workers is not None and n_workers < 1:
            raise ValueError(f"n_workers must be at least 1, but {n_workers} was given")
        if format not in WRITERS:
            raise ValueError(f"format must be {' or '.join(WRITERS)}, but {format!r} was given")
        self._plot_state, self._pickled_plot_state = plot_state, _pickled(plot_state)
        self._format, self._style = format, plotting.current()
        self._fps, self._n_workers = fps, n_workers
        self._pool: ProcessPoolExecutor | None = None
        self._writer: Mp4Writer | None = None
        self._bytes: bytes | None = None
        self._pending = collections.deque()  # (frame number, image or future), oldest first

    def __enter__(self) -> ParallelEncoder:
        writer = WRITERS[self._format](self._fps)
        self._writer, self._bytes, self._n_frames = writer, None, 0
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
                future = self._workers().submit(
                    _draw_pickled, self._pickled_plot_state, state, plotting.current()
                )
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

    def save(self, path: str | os.PathLike) -> Film:
        """Writes the video to ``path``, an mp4 or GIF as ``format`` says, and returns the path.

        Writes atomically: if it fails, an existing file is unchanged. Creates missing folders.
        """
        video, path = self._finished(), Film(path)
        if path.suffix != f".{self._format}":
            raise ValueError(
                f"this video is of format {self._format}, but '{path}' was given: use "
                f"{path.with_suffix('.' + self._format).name}"
            )
        return _write(path, video)

    def notebook(self) -> HTML:
        """Returns the video as an object that notebooks display. The encoder itself is one, too."""
        html = self._repr_html_()
        try:
            from IPython.display import HTML  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ImportError(
                "showing a video in a notebook needs IPython, which is not installed: pip install "
                "ipython, or save the video instead"
            ) from None
        return HTML(html)

    def _repr_html_(self) -> str:
        return _html(self._finished(), f".{self._format}")

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
            self._pool = workers.pool(self._n_workers)
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


@contextlib.contextmanager
def _frame_errors(number: int) -> Iterator[None]:
    """Adds the frame's number to an exception. Signals pass unchanged."""
    try:
        yield
    except Exception as error:
        first_line = next(iter(str(error).splitlines()), "")
        raise RuntimeError(
            f"frame {number} could not be recorded: {type(error).__name__}: {first_line}"
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


def _draw_pickled(pickled: bytes, state: Tree, style: plotting.Style) -> np.ndarray:
    """Draws a state in a worker process."""
    with plotting.styled(**vars(style)):
        return draw(_unpickled(pickled), state)


def draw(plot_state: Callable, state: Tree) -> np.ndarray:
    """Returns what ``plot_state`` draws of a numpyified state, as (H, W, 3) uint8.

    Closes the figure if pyplot knows it. Below the note and the title of the current
    :class:`megastep.plotting.Style`, if there are any.
    """
    with _drawn(plot_state, state) as drawing:
        return plotting.rasterise(drawing) if hasattr(drawing, "savefig") else drawing


@contextlib.contextmanager
def _drawn(plot_state, state) -> Iterator:
    """What ``plot_state`` draws: a figure, or an image (H, W, 3) uint8."""
    drawing = plot_state(state)
    if isinstance(drawing, np.ndarray):
        drawing = as_image(drawing)
        yield _captioned(drawing)
        return
    if not hasattr(drawing, "savefig"):
        raise TypeError(
            "plot_state must return a matplotlib figure or an array, but it returned a "
            f"{type(drawing).__name__}"
        )
    try:
        if isinstance(drawing, plotting.Picture):
            yield drawing
        else:
            yield _captioned(plotting.rasterise(drawing)) if _has_caption() else drawing
    finally:
        if "matplotlib.pyplot" in sys.modules:
            sys.modules["matplotlib.pyplot"].close(drawing)


def _has_caption() -> bool:
    return bool(plotting.current().note or plotting.current().title)


def _captioned(image) -> Any:
    return plotting.captioned(image) if _has_caption() else image


# ---- Files ----


class Film(type(pathlib.Path())):
    """The path of a film or a picture, which notebooks show."""

    def _repr_html_(self) -> str:
        return _html(self.read_bytes(), self.suffix)


def _html(content: bytes, ending: str) -> str:
    kind, tag = ENDINGS[ending]
    source = f'src="data:{kind};base64,{base64.b64encode(content).decode()}"'
    return tag.format(source)


def _write(path: Film, content: bytes) -> Film:
    """Writes a file atomically, in a folder that is made if it is missing. Returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content)
    return path


def _check_packages(*names: str) -> None:
    """Raises ImportError if a package that films need cannot be imported, saying why."""
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:  # also of a backend that MPLBACKEND names
            reason = next(iter(str(error).splitlines()), "")
            raise ImportError(f"drawing needs {name}, which fails: {reason}") from error


def check_path(path: str | os.PathLike) -> None:
    """Raises ValueError if no film or picture can have this name."""
    if pathlib.Path(path).suffix not in ENDINGS:
        raise ValueError(
            f"'{path}' is neither a film, .mp4 or .gif, nor its last frame, .png, .svg or .pdf"
        )


# ---- Films ----


class Player(NamedTuple):
    """What is filmed: the environment of a lane of ``env``, played by ``policy``. Players of the
    same ``env`` have the same policy.

    Attributes:
        title: above the picture.
        lane: number of the lane.
        steps: frames, if other than the film's.
        expected: what the lane's return must be in the last frame, if not None.
    """

    env: Env
    policy: PolicyLike
    title: str | None = None
    lane: int = 0
    steps: int | None = None
    expected: float | None = None


def film(
    env: Env,
    policy: PolicyLike,
    path: str | os.PathLike,
    steps: int,
    greedy: bool = False,
    seed: int = 1,
    **look,
) -> Film:
    """Films environment 0 of `env` for some steps from its reset, each a frame. Returns the path,
    which a notebook shows as the film.

    Args:
        path: an .mp4 or .gif, or a .png, .svg or .pdf, which is the last frame.
        look: theme, dpi, title, speed, trail and axes as in :func:`film_all`.

    Raises:
        ValueError: for another kind of file, or an environment that cannot be drawn.
        OSError: the file cannot be written.
        RuntimeError: naming the first frame that failed.
    """
    return film_all(
        [Player(env, policy, look.pop("title", None))], path, steps, greedy, seed, **look
    )


@torch.no_grad()
def film_all(
    players: Sequence[Player],
    path: str | os.PathLike,
    steps: int,
    greedy: bool = False,
    seed: int = 1,
    theme: str = "light",
    dpi: float = 100,
    speed: float = 1.0,
    trail: int = 60,
    axes: bool = False,
) -> Film:
    """Films several environments at once, in a grid; otherwise as :func:`film`.

    Args:
        steps: frames of each player. Who is at the end before others stays as it was there.
        theme: light or dark.
        dpi: pixels per inch; an environment's picture has 720 lines at 100.
        speed: how much faster than the environment's own frames per second.
        trail: steps of the agents' trails.
        axes: draw axes in metres.
    """
    path = Film(path)
    check_path(path)
    for env in (player.env for player in players):
        if getattr(env, "plot_state", None) is None or not hasattr(env, "state"):
            raise ValueError(
                f"{type(env).__name__} cannot be drawn: it needs the methods state(e) and "
                "plot_state(state), which docs/new-environment.md shows"
            )
    if path.is_dir():
        raise ValueError(f"{path} is a folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=path.parent).close()  # an error now, not when all is drawn
    _check_packages("matplotlib", *["av"] * (path.suffix[1:] in WRITERS))
    moments = film_moments(players, steps, greedy, seed, trail)
    with plotting.styled(theme=theme, dpi=dpi, axes=axes):
        if path.suffix[1:] in WRITERS:
            fps = optional(players[0].env, "fps") * speed
            return _film(players, moments, fps, path)
        (last,) = collections.deque(moments, maxlen=1)
        return _write(path, _still(players, last, path.suffix[1:]))


def _film(players, moments, fps, path) -> Film:
    """Draws pictures and images, which are fast, in this process, others in worker processes."""
    format, plot_state = path.suffix[1:], players[0].env.plot_state
    first = next(moments)
    with _frame_errors(0):
        in_workers = len(players) == 1 and not _is_fast(players[0], first[0])
    # the encoder draws nothing itself if it is given images
    with ParallelEncoder(plot_state if in_workers else _frame_errors, fps, None, format) as encoder:
        for number, moment in enumerate(itertools.chain([first], moments)):
            if in_workers:
                with plotting.styled(title=players[0].title, note=moment[0].note):
                    encoder(moment[0].state)
            else:
                with _frame_errors(number):
                    image = _image(players, moment)
                encoder.frame(image)
    return encoder.save(path)


def _is_fast(player, moment) -> bool:
    with _drawing(player, moment) as drawing:
        return isinstance(drawing, (np.ndarray, plotting.Picture))


@contextlib.contextmanager
def _drawing(player, moment) -> Iterator:
    """The drawing of a moment, in the style of the film."""
    with plotting.styled(title=player.title, note=moment.note):
        with _drawn(player.env.plot_state, moment.state) as drawing:
            yield drawing


def _image(players, moments) -> np.ndarray:
    images = []
    for player, moment in zip(players, moments, strict=True):
        with plotting.styled(title=player.title, note=moment.note):
            images.append(draw(player.env.plot_state, moment.state))
    return images[0] if len(images) == 1 else plotting.side_by_side(images)


def _still(players, moments, format) -> bytes:
    """Returns a picture of the moments as a file of that format."""
    with _drawing(players[0], moments[0]) as drawing:
        if len(players) > 1 or not hasattr(drawing, "savefig"):
            drawing = plotting.framed(_image(players, moments))
        return plotting.encoded(drawing, format)
