"""Floor plans: rooms, and walls in their colours."""

from __future__ import annotations

import collections
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from contourpy import contour_generator
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.path import Path
from matplotlib.transforms import IdentityTransform
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw
from scipy import ndimage

from megastep.colour import gamma_encode
from megastep.plotting.pictures import Area

CELL = 0.05  # metres: of the grid on which rooms are found
WALL = 2.6  # points: width of walls
BORDER = 0.25  # metres around a plan
FOOT = 0.24  # inches below a plan, for the scale bar
MAX_KEPT = 16  # plans whose pixels are kept


def plot_scenery(
    lines: ArrayLike,
    colours: Sequence[ArrayLike],
    lights: ArrayLike | None = None,
    seen: Sequence[ArrayLike] | None = None,
    ax: Area | Axes | None = None,
    views: np.ndarray | None = None,
) -> Area | Axes:
    """Draws the floor plan of one environment: rooms, walls in their colours, a scale bar. Returns
    what it is drawn on.

    Args:
        lines: (L, 2, 2) endpoints of walls in metres.
        colours: one (w, 3) array per line, its w texels in linear light.
        lights: (K, 2 or more), x and y first. Rooms are where their light gets to, around corners.
        seen: one (w,) array of bools per line; texels that are False are grey. Default: all seen.
        views: (n, R, 2), polygons that were seen, in order; the rest of the floor is hatched.
        ax: an area of :func:`panels`, or matplotlib axes. Default: new axes of pyplot.
    """
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.subplots(figsize=(6, 6))[1]
    area = Area.on(ax)
    plan = Plan(area, np.asarray(lines, np.float32).reshape(-1, 2, 2), colours, lights, seen, views)
    area.fit(plan.low - BORDER, plan.high + BORDER, FOOT)
    area.add(plan.draw, 0)
    _scale_bar(area, plan)
    return ax


class Plan:
    """Floor and walls of a plan. In pixels they are drawn once, and later only what was seen since;
    what is drawn is kept in memory for each of the last plans.
    """

    def __init__(self, area, lines, colours, lights, seen, views) -> None:
        self.area, self.lines, self.lights, self.views = area, lines, lights, views
        self.widths = np.array([len(np.asarray(texels)) for texels in colours], int)
        self.texels = _joined(colours, np.float32, (0, 3))
        self.seen = None if seen is None else _joined(seen, bool, (0,))
        points = lines.reshape(-1, 2) if len(lines) else np.array([[0.0, 0.0], [1.0, 1.0]])
        self.low, self.high = points.min(0), points.max(0)

    def draw(self, renderer) -> None:
        """Draws floor and walls."""
        if not isinstance(renderer, RendererAgg):
            self.draw_floor(renderer)
            self.draw_views(renderer, 0)
            self.draw_walls(renderer, np.full(len(self.texels), self.seen is None))
            if self.seen is not None:
                self.draw_walls(renderer, self.seen, self.seen)
            return
        key = (
            *(part.tobytes() for part in (self.lines, self.texels)),
            self.area.transform.get_matrix().tobytes(),
            (renderer.width, renderer.height, renderer.dpi),
            (self.area.style.theme, self.seen is None, self.views is None),
        )
        if key not in _KEPT:
            _KEPT[key] = _Pixels(self, renderer)
            if len(_KEPT) > MAX_KEPT:
                _KEPT.popitem(last=False)
        _KEPT.move_to_end(key)
        frame, shown = np.asarray(renderer.buffer_rgba()), _KEPT[key].update(self)
        x0, y0, x1, y1 = np.round(self.area.bbox.extents).astype(int)
        height = len(frame)
        rows, columns = slice(max(height - y1, 0), height - y0), slice(max(x0, 0), x1)
        frame[rows, columns] = shown[rows, columns]

    def draw_floor(self, renderer) -> None:
        """Draws the floor, hatched if it counts where agents looked."""
        theme, area = self.area.style.colours, self.area
        x0, y0, x1, y1 = area.bbox.extents
        area.draw_path(renderer, _rectangle(x0, y0, x1, y1), IdentityTransform(), theme.outside)
        rooms = _rooms(self.lines.tobytes(), _points(self.lights).tobytes())
        fill, hatch = (theme.floor, None) if self.views is None else (theme.unseen, theme.hatch)
        area.draw_path(renderer, rooms, area.transform, fill, hatch=hatch)

    def draw_views(self, renderer, first) -> None:
        """Draws the floor that was seen, from the view of a number on."""
        area, floor = self.area, self.area.style.colours.floor
        for view in () if self.views is None else self.views[first:]:
            area.draw_path(renderer, Path(view, closed=False), area.transform, floor, floor, 0.5)

    def draw_walls(self, renderer, is_seen, only: slice | np.ndarray = slice(None)) -> None:
        """Draws texels, all or some: grey where they are not seen."""
        theme = self.area.style.colours
        colours = np.where(
            is_seen[:, None], wall_colours(self.texels, *theme.wall), to_rgb(theme.unseen_wall)
        )
        # projecting caps overlap the neighbours; otherwise the background shows between texels
        drawn = LineCollection(
            [*texel_segments(self.lines, self.widths)[only]],
            colors=colours[only],
            linewidths=WALL,
            capstyle="projecting",
        )
        drawn.set_figure(self.area.get_figure())
        drawn.set_transform(self.area.transform)
        drawn.set_clip_box(self.area.bbox)
        drawn.draw(renderer)


_KEPT: collections.OrderedDict[tuple, _Pixels] = collections.OrderedDict()


class _Pixels:
    """The pixels of a plan, with what has been seen so far."""

    def __init__(self, plan: Plan, renderer):
        size = renderer.width, renderer.height, renderer.dpi
        self.floor, self.walls = RendererAgg(*size), RendererAgg(*size)
        plan.draw_floor(self.floor)
        plan.draw_walls(self.walls, np.full(len(plan.texels), plan.seen is None))
        self.layers = [np.asarray(layer.buffer_rgba()) for layer in (self.floor, self.walls)]
        self.start = [layer.copy() for layer in self.layers]
        self.views, self.seen = np.zeros((0, 0, 2)), np.zeros(len(plan.texels), bool)
        self.joined: Any = None

    def update(self, plan: Plan) -> np.ndarray:
        """Draws what was seen since the last call. Returns the image, (H, W, 4)."""
        seen = self.seen if plan.seen is None else plan.seen
        views, n = self.views if plan.views is None else plan.views, len(self.views)
        if (self.seen & ~seen).any() or (
            n and (n > len(views) or (views[n - 1] != self.views[-1]).any())
        ):  # another episode
            for layer, start in zip(self.layers, self.start):
                layer[:] = start
            self.seen, self.joined, n = np.zeros_like(seen), None, 0
        new = seen & ~self.seen
        if self.joined is None or len(views) > n or new.any():
            plan.draw_views(self.floor, n)
            if new.any():
                plan.draw_walls(self.walls, seen, new)
            self.joined = np.array(Image.alpha_composite(*map(Image.fromarray, self.layers)))
        self.views, self.seen = views, seen
        return self.joined


def _joined(parts, dtype, empty) -> np.ndarray:
    return np.concatenate([np.zeros(empty, dtype), *(np.asarray(part, dtype) for part in parts)])


def _points(lights) -> np.ndarray:
    points = np.zeros((0, 2)) if lights is None or not len(lights) else np.asarray(lights)[:, :2]
    return np.ascontiguousarray(points, np.float32)


def texel_segments(lines: ArrayLike, widths: ArrayLike) -> np.ndarray:
    """Returns the endpoints of texels, (T, 2, 2), of lines (L, 2, 2) of ``widths`` texels."""
    lines, widths = np.asarray(lines, np.float32), np.asarray(widths, int)
    line = np.repeat(np.arange(len(lines)), widths)
    texel = np.arange(len(line)) - (widths.cumsum() - widths)[line]
    fractions = np.stack([texel, texel + 1], 1) / np.maximum(widths[line], 1)[:, None]
    start, along = lines[line, 0], lines[line, 1] - lines[line, 0]
    return start[:, None] + fractions[..., None] * along[:, None]


def wall_colours(texels: ArrayLike, least: float = 0.5, greatest: float = 1.0) -> np.ndarray:
    """Returns sRGB colours of lit texels (T, 3): full hue, brightness ``least`` to ``greatest``."""
    texels = np.clip(np.asarray(texels, np.float32).reshape(-1, 3), 0, None)
    peak = texels.max(1, keepdims=True, initial=0)
    hue = gamma_encode(texels / np.maximum(peak, 1e-6))
    return hue * (least + (greatest - least) * gamma_encode(np.clip(2.5 * peak, 0, 1)))


def _rectangle(x0, y0, x1, y1) -> Path:
    return Path([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)], closed=True)


@functools.lru_cache(MAX_KEPT)
def _rooms(lines_bytes: bytes, lights_bytes: bytes) -> Any:
    """Returns the outline of the floor that is connected with a light, as a matplotlib path."""
    lines = np.frombuffer(lines_bytes, np.float32).reshape(-1, 2, 2)
    if not len(lines):
        return Path(np.zeros((0, 2)))
    low, high = lines.min((0, 1)) - 3 * CELL, lines.max((0, 1)) + 3 * CELL
    n_columns, n_rows = (np.ceil((high - low) / CELL).astype(int) + 1).tolist()
    image = Image.new("1", (n_columns, n_rows))
    pen = ImageDraw.Draw(image)
    for line in np.round((lines - low) / CELL):
        pen.line([*line.ravel().tolist()], fill=1)
    wall = np.array(image, bool)
    points = np.frombuffer(lights_bytes, np.float32).reshape(-1, 2)
    columns, rows = np.clip(((points - low) / CELL).astype(int), 0, [n_columns - 1, n_rows - 1]).T
    parts: Any = ndimage.label(~wall)[0]  # pyright: ignore[reportIndexIssue]
    room = np.isin(parts, parts[rows, columns]) & ~wall
    if not room.any() or room[0, 0]:
        return _rectangle(*lines.min((0, 1)), *lines.max((0, 1)))
    x, y = (low[a] + CELL * np.arange(n) for a, n in ((0, n_columns), (1, n_rows)))
    contours: Any = contour_generator(x, y, room.astype(float), fill_type="OuterCode")
    polygons, codes = contours.filled(0.02, 2)  # to the middle of the walls
    return Path(np.concatenate(polygons), np.concatenate(codes))


def room_outlines(lines: ArrayLike, lights: ArrayLike) -> list[list[list[float]]]:
    """Returns the outlines of the rooms as closed polygons of points x, y in metres, rounded to
    centimetres, from walls (L, 2, 2) and lights (K, 2 or more). What lies in an odd number of
    them is floor.
    """
    lines = np.ascontiguousarray(lines, np.float32)
    path = _rooms(lines.tobytes(), _points(lights).tobytes())
    polygons = path.to_polygons(closed_only=True)
    return [np.round(polygon.astype(float), 2).tolist() for polygon in polygons]


def _scale_bar(area, plan) -> None:
    """Draws a bar of a round number of metres in the plan's lower right corner."""
    if not hasattr(area, "_inches") or not len(plan.lines):
        return
    inch, per_metre = area.get_figure().dpi, area.transform.get_matrix()[0, 0]
    metres = next((m for m in (1, 2, 5, 10, 20, 50, 100) if m * per_metre > 0.5 * inch), 200)
    right, left, y = area.width - 0.14, area.width - 0.14 - metres * per_metre / inch, 0.1
    bar = Path([(left, y + 0.05), (left, y), (right, y), (right, y + 0.05)])
    colour = area.style.colours.faint
    area.add(lambda r: area.draw_path(r, bar, area._inches, None, colour, 1.2), 8)
    beside = left - 0.07, y + 0.03
    area.text(beside, f"{metres} m", 8, size=8, colour=colour, align="right", inches=True)
