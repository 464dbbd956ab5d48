"""Figures that are fast to draw: areas for a plan, strips and text, without matplotlib's axes.

Making and drawing an ``Axes`` takes 10 to 20 ms, too long for a film. An :class:`Area` is one
artist that calls the renderer itself, so that the same drawing goes into pixels, SVG and PDF.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.transforms import Affine2D, Bbox, TransformedBbox
from PIL import Image

from megastep.plotting.styles import current

WIDTH, HEIGHT = 6.4, 7.2  # inches: 720 lines at 100 pixels per inch
MARGIN = 0.16
STRIP = 0.3  # height of a strip's row of pixels
GAP = 0.12  # between strips
LABEL, DEGREES = 0.62, 0.25  # width of a strip's label, and of cameras' yaws in it
LEAST_PLAN = 3.6  # height of a plan above many strips
HEAD, TITLE = 0.42, 0.34  # height of the line of numbers, and of a title above it


class Picture(Figure):
    """A matplotlib figure that notebooks show, and that pyplot does not know."""

    def __init__(self, *args, **settings) -> None:
        super().__init__(*args, **settings)
        self.style = current()

    def _repr_png_(self) -> bytes:
        return encoded(self, "png")


class Area(Artist):
    """A rectangle of a figure, and what is drawn in it.

    Points are data coordinates after :meth:`fit`, otherwise inches from the lower left corner.
    Things with a higher ``z`` cover those with a lower one.
    """

    strip_label: Area  # beside a strip

    def __init__(self, figure: Figure, left: float, bottom: float, width: float, height: float):
        super().__init__()
        self.width, self.height = width, height
        self._inches = Affine2D().translate(left, bottom) + figure.dpi_scale_trans
        self._place(figure, TransformedBbox(Bbox.from_bounds(0, 0, width, height), self._inches))
        self.transform: Any = self._inches
        figure.add_artist(self)

    @classmethod
    def on(cls, ax: Area | Axes) -> Area:
        """Returns ``ax`` itself, or what draws on matplotlib's axes in their data coordinates."""
        if isinstance(ax, Area):
            return ax
        for artist in ax.artists:
            if isinstance(artist, Area):
                return artist
        area = cls.__new__(cls)
        Artist.__init__(area)
        area._place(ax.figure, ax.bbox)
        area.transform = ax.transData
        ax.add_artist(area)
        return area

    def _place(self, figure, bbox) -> None:
        self.bbox, self._things, self.style = bbox, [], current()
        self.set_figure(figure)

    def fit(self, low: np.ndarray, high: np.ndarray, foot: float = 0.0) -> None:
        """Shows points from ``low`` to ``high``, (2,) each, as data, above a ``foot``, inches."""
        if self.axes is not None:
            self.axes.set_aspect("equal", adjustable="datalim")
            self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            return
        size = np.array([self.width, self.height - foot])
        scale = float((size / (high - low)).min())  # inches per unit
        low = (low + high - size / scale) / 2 - [0, foot / scale]
        self.transform = Affine2D().translate(*-low).scale(scale) + self._inches

    # ---- Things to draw ----

    def add(self, thing: Callable, z: float = 0) -> None:
        """Adds a function that draws with a renderer."""
        self._things.append((z, thing))

    def polygon(
        self, points, z=0.0, *, fill=None, edge=None, width=0.0, alpha=1.0, clip=True
    ) -> None:
        """Draws a closed polygon, (n, 2); the edge's ``width`` is in points."""
        points = np.asarray(points, float)
        path, look = Path(np.concatenate([points, points[:1]]), closed=True), (fill, edge, width)
        self.add(lambda r: self.draw_path(r, path, self.transform, *look, alpha, clip=clip), z)

    def line(self, points, z=0.0, *, colour, width=1.0, alpha=1.0) -> None:
        """Draws a line through points, (n, 2)."""
        path = Path(np.asarray(points, float))
        self.add(lambda r: self.draw_path(r, path, self.transform, None, colour, width, alpha), z)

    def draw_path(
        self, renderer, path, at, fill=None, edge=None, width=0.0, alpha=1.0, hatch=None, clip=True
    ) -> None:
        """Draws a matplotlib path at once, ``at`` a transform."""
        gc = renderer.new_gc()
        gc.set_linewidth(renderer.points_to_pixels(width) if edge is not None else 0)
        gc.set_foreground(to_rgba(edge if edge is not None else "k", alpha), isRGBA=True)
        gc.set_joinstyle("round")
        gc.set_capstyle("round")
        gc.set_clip_rectangle(self.bbox if clip else None)
        if hatch is not None:
            gc.set_hatch("//")
            gc.set_hatch_color(to_rgba(hatch))
            gc.set_hatch_linewidth(1.0)
        renderer.draw_path(gc, path, at, None if fill is None else to_rgba(fill, alpha))
        gc.restore()

    def disc(
        self, centre, radius, z=0.0, *, fill, edge=None, width=0.0, alpha=1.0, least=0.0
    ) -> None:
        """Draws a disc whose radius is ``radius`` units, or ``least`` points if that is more."""

        def draw(renderer) -> None:
            matrix = self.transform.get_matrix()
            pixels = max(matrix[0, 0] * radius, renderer.points_to_pixels(least))
            x, y = self.transform.transform(np.asarray(centre, float))
            at = Affine2D().scale(pixels).translate(x, y)
            self.draw_path(renderer, Path.unit_circle(), at, fill, edge, width, alpha)

        self.add(draw, z)

    def text(
        self, point, words, z=9.0, *, size=10.0, colour=None, bold=False, align="left", inches=False
    ) -> None:
        """Draws a line of text with the middle of its letters at the height of ``point``.

        Args:
            size: in points.
            align: left, centre or right of the point.
            inches: the point is in inches from the area's corner, whatever :meth:`fit` did.
        """
        colour = self.style.colours.text if colour is None else colour

        def draw(renderer) -> None:
            x, y = (self._inches if inches else self.transform).transform(np.asarray(point, float))
            y -= 0.36 * renderer.points_to_pixels(size)  # half the height of a capital
            shift = {"left": 0, "centre": 0.5, "right": 1}[align]
            gc = renderer.new_gc()
            if isinstance(renderer, RendererAgg):
                images, total = _line(words, size, bold, colour, renderer.dpi)
                x -= shift * total
                for pixels, width, below in images:
                    renderer.draw_image(gc, round(x), round(y) - below, pixels)
                    x += width
            else:
                font = _font(size, bold)
                x -= shift * renderer.get_text_width_height_descent(words, font, False)[0]
                gc.set_foreground(to_rgba(colour), isRGBA=True)
                if renderer.flipy():
                    y = renderer.get_canvas_width_height()[1] - y
                renderer.draw_text(gc, x, y, words, font, 0)
            gc.restore()

        self.add(draw, z)

    def image(self, pixels: np.ndarray, z: float = 0) -> None:
        """Fills the area with an image, (H, W, 3) floats in [0, 1] or uint8, each pixel a block."""

        def draw(renderer) -> None:
            left, bottom, width, height = self.bbox.bounds
            scale = renderer.get_image_magnification()
            n_columns, n_rows = max(round(width * scale), 1), max(round(height * scale), 1)
            colours = pixels if pixels.dtype == np.uint8 else (255 * pixels + 0.5).astype(np.uint8)
            rows = np.arange(n_rows) * len(pixels) // n_rows
            columns = np.arange(n_columns) * pixels.shape[1] // n_columns
            rgba = np.full((n_rows, n_columns, 4), 255, np.uint8)
            rgba[..., :3] = colours[rows[:, None], columns]
            gc = renderer.new_gc()
            renderer.draw_image(gc, round(left), round(bottom), rgba[::-1])
            gc.restore()

        self.add(draw, z)

    def draw(self, renderer) -> None:
        """Draws all things, the lowest first."""
        if not self.get_visible():
            return
        for _, thing in sorted(self._things, key=lambda pair: pair[0]):
            thing(renderer)
        self.stale = False


@functools.lru_cache(64)
def _font(size, bold) -> FontProperties:
    return FontProperties(family="DejaVu Sans", size=size, weight="bold" if bold else "normal")


def _line(words, size, bold, colour, dpi) -> tuple[list, float]:
    """Returns the words of a line, most of which have been drawn before, and its width."""
    images = [_word(word, size, bold, colour, dpi) for word in words.split(" ")]
    return images, sum(width for _, width, _ in images) - 0.3 * size * dpi / 72


@functools.lru_cache(1024)
def _word(word, size, bold, colour, dpi) -> tuple[np.ndarray, float, int]:
    """Returns a word as an image, lowest row first, its width with a space, and rows below."""
    font = _font(size, bold)
    width, _, _ = RendererAgg(1, 1, dpi).get_text_width_height_descent(word, font, False)
    letters = size * dpi / 72
    below = int(np.ceil(0.3 * letters))
    renderer = RendererAgg(int(np.ceil(width)) + 2, int(np.ceil(letters)) + below, dpi)
    gc = renderer.new_gc()
    gc.set_foreground(to_rgba(colour), isRGBA=True)
    renderer.draw_text(gc, 0, renderer.height - below, word, font, 0)
    return np.array(renderer.buffer_rgba())[::-1], width + 0.3 * letters, below


# ---- Layouts ----


def panels(
    n_strips: int = 0, title: str | None = None, n_cameras: int = 1, columns: int = 1
) -> tuple[Picture, Area, list[Area]]:
    """Makes a picture with a floor plan, a line of numbers above it, and strips for images below:
    640 pixels wide and 720 high (at a :attr:`Style.dpi` of 100), or higher for many strips.

    Args:
        n_strips: number of strips.
        title: the line of numbers, such as "step 3 · 2 kills".
        n_cameras: rows of pixels per strip; a strip is as high as its rows.
        columns: strips side by side.

    Returns:
        The figure, the area of the plan, and the area of each strip, row by row.
    """
    style = current()
    strip = STRIP * (1 + 0.6 * (n_cameras - 1))
    n_rows = -(-n_strips // columns)
    below = MARGIN / 2 + n_rows * (strip + GAP)
    head = HEAD + TITLE * (style.title is not None)
    width, height = WIDTH, max(HEIGHT, head + LEAST_PLAN + below)
    picture = Picture(figsize=(width, height), dpi=style.dpi, facecolor=style.colours.page)
    _write_head(picture, height, title)
    tall = height - head - below - MARGIN / 2
    plan = Area(picture, MARGIN, below + MARGIN / 2, width - 2 * MARGIN, tall)
    cell = (width - 2 * MARGIN - (columns - 1) * MARGIN) / columns
    label = LABEL + DEGREES * (n_cameras > 1)
    strips = []
    for i in range(n_strips):
        row, column = divmod(i, columns)
        x, y = MARGIN + column * (cell + MARGIN), below - (row + 1) * (strip + GAP) + GAP / 2
        strips.append(Area(picture, x + label, y, cell - label, strip))
        strips[-1].strip_label = Area(picture, x, y, label, strip)
    return picture, plan, strips


def captioned(image: np.ndarray) -> np.ndarray:
    """Returns an image (H, W, 3) uint8 below title and note; a small one is enlarged."""
    style = current()
    scale = max(round(100 * (HEIGHT - HEAD)) // len(image), 1)
    height, width = (scale * size / 100 for size in image.shape[:2])
    head, page = HEAD + TITLE * (style.title is not None), max(width, 3.2)
    picture = Picture(figsize=(page, head + height), dpi=100, facecolor=style.colours.page)
    _write_head(picture, head + height, None)
    Area(picture, (page - width) / 2, 0, width, height).image(image)
    return rasterise(picture)


def _write_head(picture, height, numbers) -> None:
    """Writes a line of numbers and a title, smaller where they are longer than the picture."""
    style, width = picture.style, picture.get_figwidth() - 2 * MARGIN
    tall = HEAD + TITLE * (style.title is not None)
    head = Area(picture, MARGIN, height - tall, width, tall)
    line = " · ".join(part for part in (numbers, style.note) if part)
    for words, y, size, bold in (line, 0.2, 13, False), (style.title, tall - 0.22, 15, True):
        if words:
            look = bold, style.colours.text, picture.dpi
            while size > 1 and _line(words, size, *look)[1] > width * picture.dpi:
                size *= 0.95
            head.text((0, y), words, size=size, bold=bold)


def plot_level(area: Area, level: float) -> None:
    """Draws a level in [0, 1], such as health, as a bar above a strip, red (0) to green (1)."""
    colour = (0.85 * (1 - level) + 0.1, 0.25 + 0.45 * level, 0.2)
    bottom, top = area.height + 0.02, area.height + 0.07
    for right, fill in (1, area.style.colours.outside), (level, colour):
        width = right * area.width
        corners = [(0, bottom), (width, bottom), (width, top), (0, top)]
        area.polygon(corners, 1, fill=fill, clip=False)


def rasterise(figure: Figure) -> np.ndarray:
    """Renders a figure with Agg, whatever its canvas. Returns (H, W, 3) uint8."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba()))
    return np.array(image.convert("RGB"))  # faster than numpy's slices


def encoded(figure: Figure, format: str) -> bytes:
    """Returns a figure as a file of format png, svg or pdf, the same bytes each time."""
    file = io.BytesIO()
    date = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(format)
    with rc_context({"svg.hashsalt": "megastep", "svg.fonttype": "none"}):
        figure.savefig(file, format=format, dpi=figure.dpi, metadata=date)
    return file.getvalue()


def framed(image: np.ndarray) -> Picture:
    """Returns an image, (H, W, 3) uint8, as a picture of as many pixels."""
    dpi = current().dpi
    height, width = (size / dpi for size in image.shape[:2])
    picture = Picture(figsize=(width, height), dpi=dpi)
    Area(picture, 0, 0, width, height).image(image)
    return picture


def side_by_side(images: Sequence[np.ndarray]) -> np.ndarray:
    """Returns images, (H, W, 3) uint8 each, as one, in a grid about as wide as high."""
    columns = int(np.ceil(np.sqrt(len(images))))
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    rows = -(-len(images) // columns)
    page = (255 * np.array(to_rgba(current().colours.page)[:3])).astype(np.uint8)
    grid = np.broadcast_to(page, (rows * height, columns * width, 3)).copy()
    for i, image in enumerate(images):
        y, x = i // columns * height, i % columns * width
        grid[y : y + image.shape[0], x : x + image.shape[1]] = image
    return grid
