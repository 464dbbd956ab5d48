"""Figures with a floor plan and strips for images, and figures as arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STRIP = 0.09  # height of a strip over its width


def panels(
    n_strips: int = 0, width: float = 6.0, title: str | None = None, n_cameras: int = 1
) -> tuple[Figure, Axes, list[Axes]]:
    """Makes a figure with a square for the plan and strips below it.

    Args:
        n_strips: number of strips.
        width: of the figure, in inches of 100 pixels.
        title: above the plan.
        n_cameras: rows of pixels per strip; a strip is as high as its rows.

    Returns:
        The figure, the axes of the plan, and the axes of each strip. The figure is unknown to
        pyplot, so it need not be closed.
    """
    from matplotlib.figure import Figure

    margin, gap = 0.55, 0.5  # inches: around the plan, and below each strip for its labels
    inner_width = width - 2 * margin
    strip_height = STRIP * inner_width * n_cameras
    height = 2 * margin + inner_width + n_strips * (strip_height + gap)
    figure = Figure(figsize=(width, height), dpi=100)

    def axes(bottom, axes_height) -> Axes:
        sizes = margin / width, bottom / height, inner_width / width, axes_height / height
        return figure.add_axes(sizes)

    plan = axes(height - margin - inner_width, inner_width)
    if title is not None:
        plan.set_title(title)
    bottoms = [gap + (n_strips - 1 - i) * (strip_height + gap) for i in range(n_strips)]
    return figure, plan, [axes(bottom, strip_height) for bottom in bottoms]


def panels_beside(
    n_rows: int, n_strips: int, width: float = 12.0, title: str | None = None
) -> tuple[Figure, Axes, list[list[Axes]]]:
    """Makes a figure with a square for the plan on the left and rows of strips on the right.

    Args:
        n_rows: number of rows, for example one per agent.
        n_strips: strips per row, one above the other.
        width, title: as in :func:`panels`.

    Returns:
        The figure, the axes of the plan, and a list of the strips' axes per row.
    """
    from matplotlib.figure import Figure

    margin, head, gap = 0.55, 0.3, 0.08  # inches: around the plan, above a row, between strips
    plan_width = width / 2 - 1.5 * margin
    row_height = max(plan_width / n_rows, head + n_strips * (0.18 + gap))
    height = 2 * margin + n_rows * row_height
    strip_height = (row_height - head) / n_strips - gap
    figure = Figure(figsize=(width, height), dpi=100)

    def axes(left, bottom, axes_height) -> Axes:
        sizes = left / width, bottom / height, plan_width / width, axes_height / height
        return figure.add_axes(sizes)

    def strip(row, i) -> Axes:
        top = height - margin - row * row_height - head - i * (strip_height + gap)
        return axes(width / 2 + margin / 2, top - strip_height, strip_height)

    plan = axes(margin, (height - plan_width) / 2, plan_width)
    if title is not None:
        plan.set_title(title)
    return figure, plan, [[strip(row, i) for i in range(n_strips)] for row in range(n_rows)]


def plot_level(ax: Axes, level: float) -> None:
    """Draws a level in [0, 1], such as health, as a bar above ``ax``, from red (0) to green (1)."""
    from matplotlib.patches import Rectangle

    bar: dict = dict(transform=ax.transAxes, clip_on=False, linewidth=0)
    ax.add_patch(Rectangle((0, 1.02), 1, 0.12, facecolor="0.8", **bar))
    ax.add_patch(Rectangle((0, 1.02), level, 0.12, facecolor=(1 - level, 0.7 * level, 0), **bar))


def rasterise(figure: Figure) -> np.ndarray:
    """Renders a figure with Agg, whatever its canvas. Returns (H, W, 3) uint8."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
