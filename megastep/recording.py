"""Films of environments.

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
import functools
import math
import os
import pathlib
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import ArrayLike

from megastep import plotting
from megastep.arrdict import clone, numpyify
from megastep.atomic_files import write_atomically
from megastep.types import Env, PolicyLike, Tree, n_lanes, optional
from megastep.video import WRITERS, GifWriter, Mp4Writer, as_image

__all__ = ["Film", "ParallelEncoder", "Player", "film", "film_all"]

VIDEO, IMAGE = "<video controls autoplay loop muted {}></video>", "<img {}>"
ENDINGS = {  # of films and pictures: their types, and how pages show them
    ".mp4": ("video/mp4", VIDEO),
    ".gif": ("image/gif", IMAGE),
    ".png": ("image/png", IMAGE),
    ".svg": ("image/svg+xml", IMAGE),
    ".pdf": ("application/pdf", '<embed width="100%" height="720" {}>'),
}
MAX_RETURNS = 4  # of as many agents, one by one


class ParallelEncoder:
    """Draws states as frames of a video. Inside its ``with`` block, call it with a state, or
    :meth:`frame` with a finished image; after the block, use :meth:`save` or :meth:`notebook`.
    Raises RuntimeError: a frame could not be drawn; names the first such frame. Raised by any
    method.

    Args:
        plot_state: takes a numpyified state, returns a matplotlib figure or an (H, W, 3) uint8
            array.
        fps: frames per second. Where they are more than the format can show, 50 in a GIF and 120
            in an mp4, every second or third is drawn alone, and the video takes as long.
        format: mp4 or gif.
    """

    def __init__(self, plot_state: Callable, fps: float = 20, format: str = "mp4"):
        if fps <= 0:
            raise ValueError(f"fps must be more than 0 frames per second, but {fps} was given")
        if format not in WRITERS:
            raise ValueError(f"format must be {' or '.join(WRITERS)}, but {format!r} was given")
        self._plot_state, self._fps, self._format = plot_state, fps, format
        self._every = math.ceil(fps / WRITERS[format][1])
        self._writer: Mp4Writer | GifWriter | None = None
        self._bytes: bytes | None = None

    def __enter__(self) -> ParallelEncoder:
        self._writer = WRITERS[self._format][0](self._fps / self._every)
        self._bytes, self._n_frames, self._shape = None, 0, None
        return self

    def __call__(self, state: Tree) -> None:
        """Draws a state, a tree of tensors or arrays, as the next frame."""
        self._add(lambda: image_of(self._plot_state(numpyify(clone(state)))))

    def frame(self, array: ArrayLike) -> None:
        """Adds an image as the next frame: (H, W, 3), uint8 or floats in [0, 1]."""
        image = as_image(array)
        self._add(lambda: image)

    def _add(self, draw: Callable[[], np.ndarray]) -> None:
        if self._writer is None:
            raise RuntimeError(
                "frames can only be added inside the with block: with ParallelEncoder(...) as "
                "encoder"
            )
        try:
            if self._n_frames % self._every == 0:
                image = draw()
                self._shape = self._shape or image.shape
                if image.shape != self._shape:
                    size = "{1} x {0} pixels".format
                    raise ValueError(
                        f"all frames must have the size of the first, {size(*self._shape)}, but "
                        f"this one has {size(*image.shape)}"
                    )
                self._writer.add(image)
        except Exception as error:  # signals pass unchanged
            first_line = next(iter(str(error).splitlines()), "")
            raise RuntimeError(
                f"frame {self._n_frames} could not be recorded: {type(error).__name__}: "
                f"{first_line}"
            ) from error
        self._n_frames += 1

    def __exit__(self, kind, error, trace) -> None:
        writer, self._writer = self._writer, None
        assert writer is not None
        try:
            self._bytes = writer.close()
        except Exception:
            if kind is None:  # otherwise the error that ended the block is raised
                raise

    def save(self, path: str | os.PathLike) -> Film:
        """Writes the video, and returns its path. If it fails, an existing file is unchanged."""
        video, path = self._finished(), Film(path)
        if path.suffix != f".{self._format}":
            raise ValueError(
                f"this video is of format {self._format}, but '{path}' was given: use "
                f"{path.with_suffix('.' + self._format).name}"
            )
        return _write(path, video)

    def notebook(self) -> ParallelEncoder:
        """Returns the encoder, which notebooks show as its video."""
        self._finished()
        return self

    def _repr_html_(self) -> str:
        return _html(self._finished(), f".{self._format}")

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


def image_of(drawing: Any) -> np.ndarray:
    """Returns a matplotlib figure or an image as (H, W, 3) uint8. Closes the figure if pyplot knows
    it. Below the note and the title of the current :class:`megastep.plotting.Style`, if there are
    any.
    """
    style = plotting.current()
    if isinstance(drawing, np.ndarray):
        image = as_image(drawing)
    elif hasattr(drawing, "savefig"):
        image = plotting.rasterise(drawing)
        if "matplotlib.pyplot" in sys.modules:
            sys.modules["matplotlib.pyplot"].close(drawing)
    else:
        raise TypeError(
            "plot_state must return a matplotlib figure or an array, but it returned a "
            f"{type(drawing).__name__}"
        )
    has_caption = isinstance(drawing, plotting.Picture) or not (style.note or style.title)
    return image if has_caption else plotting.captioned(image)


# ---- Files ----


class Film(type(pathlib.Path())):
    """The path of a film or a picture, which notebooks show."""

    def _repr_html_(self) -> str:
        return _html(self.read_bytes(), self.suffix)


def _html(content: bytes, ending: str) -> str:
    kind, tag = ENDINGS[ending]
    return tag.format(f'src="data:{kind};base64,{base64.b64encode(content).decode()}"')


def _write(path: Film, content: bytes) -> Film:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content)
    return path


# ---- Films ----


class Player(NamedTuple):
    """What is filmed: environment 0 of ``env``, played by ``policy``, below a ``title``."""

    env: Env
    policy: PolicyLike
    title: str | None = None


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
        look: theme, dpi, title, speed and trail as in :func:`film_all`.

    Raises:
        ValueError: for another kind of file, or an environment that cannot be drawn.
        OSError: the file cannot be written.
        RuntimeError: naming the first frame that failed.
    """
    player = Player(env, policy, look.pop("title", None))
    return film_all([player], path, steps, greedy, seed, **look)


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
    show: Callable[[int, int], None] = lambda done, total: None,
) -> Film:
    """Films several environments at once, in a grid; otherwise as :func:`film`.

    Args:
        theme: light or dark.
        dpi: pixels per inch; an environment's picture has 720 lines at 100.
        speed: how much faster than the environment's own frames per second.
        trail: steps of the agents' trails.
        show: called after each frame with its number, and that of all.
    """
    path = Film(path)
    if path.suffix not in ENDINGS:
        raise ValueError(
            f"'{path}' is neither a film, .mp4 or .gif, nor its last frame, .png, .svg or .pdf"
        )
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
    moments = zip(*(film_moments(player, steps, greedy, seed, trail) for player in players))
    with plotting.styled(theme=theme, dpi=dpi):
        if (format := path.suffix[1:]) not in WRITERS:
            (last,) = collections.deque(moments, maxlen=1)
            return _write(path, plotting.encoded(_picture(players, last), format))
        fps = optional(players[0].env, "fps") * speed
        with ParallelEncoder(_image, fps, format) as encoder:
            for number, each in enumerate(moments, 1):
                encoder._add(functools.partial(_image, players, each))
                show(number, steps)
        return encoder.save(path)


def _image(players, moments) -> np.ndarray:
    images = []
    for player, (state, note) in zip(players, moments, strict=True):
        with plotting.styled(title=player.title, note=note):
            images.append(image_of(player.env.plot_state(state)))
    return images[0] if len(images) == 1 else plotting.side_by_side(images)


def _picture(players, moments) -> plotting.Picture:
    if len(players) > 1:
        return plotting.framed(_image(players, moments))
    (player,), ((state, note),) = players, moments
    with plotting.styled(title=player.title, note=note):
        drawing = player.env.plot_state(state)
        is_picture = isinstance(drawing, plotting.Picture)
        return drawing if is_picture else plotting.framed(image_of(drawing))


def film_moments(player: Player, steps: int, greedy, seed, trail) -> Iterator[tuple[Tree, str]]:
    """Plays from a reset. Yields before each step a numpyified state, a note of returns."""
    env, policy = cast(Any, player.env), player.policy
    n_agents, generator = optional(env, "n_agents"), torch.Generator(env.device).manual_seed(seed)
    returns = np.zeros(n_agents, np.float32)
    trails, views = collections.deque(maxlen=trail + 1), []
    world, hidden = env.reset(), policy.initial(n_lanes(env), env.device)
    for t in range(steps):
        if t:
            decision, hidden = policy(world, hidden, sample=not greedy, generator=generator)
            world = env.step(decision)
        rewards, starts = (world[k][:n_agents].cpu().numpy().ravel() for k in ("reward", "reset"))
        returns = np.where(starts, np.float32(0), returns + rewards)
        state: Any = numpyify(clone(env.state(0)))
        core = state.get("core") if isinstance(state, dict) else None
        if isinstance(core, dict) and "distances" in core:
            _add_past(core, starts, trails, views)
        note = f"mean return {returns.mean():.1f}"
        if n_agents <= MAX_RETURNS:
            note = "return " + ", ".join(f"{round(float(x), 1) + 0.0:.1f}" for x in returns)
        yield state, note


def _add_past(core: dict, starts: np.ndarray, trails: collections.deque, views: list) -> None:
    """Adds trails and views to a core's state; ``starts`` (A,) says whose episodes begin."""
    for positions in trails:
        positions[starts] = np.nan
    trails.append(np.array(core["positions"], float))
    core["trail"] = np.stack(trails)
    if starts.all():
        views.clear()
    seen = [
        plotting.view_polygon(core["positions"][a], core["angles"][a] + yaw, core["fov"], distances)
        for a, of_agent in enumerate(core["distances"])
        for yaw, distances in zip(core["yaws"], of_agent, strict=True)
    ]
    views.append(np.array(seen, np.float32).reshape(*core["distances"].shape[:2], -1, 2))
    core["views"] = np.stack(views)
