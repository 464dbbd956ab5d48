"""Floor plans: walls in their lit colours, lights, views of cameras, goals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from megastep.colour import gamma_encode

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Circle, Polygon

# grey of the plan, in sRGB: dark, because walls are drawn in the light that falls on them
BACKGROUND = 0.12
# plans are brighter than what cameras see: most walls get well under half of full light
EXPOSURE = 2.5
UNSEEN = 0.2  # contrast of unseen texels to the background, relative to seen ones


def plot_scenery(
    lines: ArrayLike,
    colours: Sequence[ArrayLike],
    lights: ArrayLike | None = None,
    seen: Sequence[ArrayLike] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws one environment from above: its lines in their lit colours, and its lights. Returns
    the axes.

    Args:
        lines, colours, seen: as in :func:`plot_lines`.
        lights: (K, 2 or more), x and y first.
    """
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.subplots(figsize=(6, 6))[1]
    ax.set_facecolor(str(BACKGROUND))
    plot_lines(ax, lines, colours, seen)
    points = np.asarray([] if lights is None else lights)
    if len(points):
        ax.scatter(
            points[:, 0],
            points[:, 1],
            s=14,
            c="gold",
            marker="*",
            linewidths=0,
        )
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.05)
    ax.autoscale_view()
    ax.set_xlabel("x, m", fontsize="small", labelpad=1)
    ax.set_ylabel("y, m", fontsize="small", labelpad=1)
    ax.tick_params(labelsize="x-small")
    return ax


def plot_lines(
    ax: Axes,
    lines: ArrayLike,
    colours: Sequence[ArrayLike],
    seen: Sequence[ArrayLike] | None = None,
    exposure: float = EXPOSURE,
    width: float = 2.5,
) -> LineCollection:
    """Draws lines texel by texel on ``ax``. Returns the matplotlib collection.

    Args:
        lines: (L, 2, 2) endpoints in metres.
        colours: one (w, 3) array per line, its w lit texels in linear light.
        seen: one (w,) array of bools per line; texels that are False are drawn faintly. By default
            all are seen.
        exposure: factor for the light.
        width: of the lines, in points.

    Raises:
        ValueError: the numbers of lines and of colour arrays differ.
    """
    from matplotlib.collections import LineCollection

    lines = np.asarray(lines, np.float32).reshape(-1, 2, 2)
    widths = np.array([len(np.asarray(texels)) for texels in colours], int)
    if len(widths) != len(lines):
        raise ValueError(
            f"plot_lines needs one array of colours per line, but {len(lines)} lines and "
            f"{len(widths)} arrays of colours were given"
        )
    line = np.repeat(np.arange(len(lines)), widths)
    texel = np.arange(len(line)) - (widths.cumsum() - widths)[line]
    fractions = np.stack([texel, texel + 1], 1) / np.maximum(widths[line], 1)[:, None]
    start, along = lines[line, 0], lines[line, 1] - lines[line, 0]
    segments = start[:, None] + fractions[..., None] * along[:, None]

    light = np.concatenate(
        [np.zeros((0, 3)), *(np.asarray(texels, np.float32) for texels in colours)]
    )
    texel_colours = gamma_encode(np.clip(exposure * light, 0, 1))
    if seen is not None:
        is_seen = np.concatenate(
            [np.zeros(0, bool), *(np.asarray(texels, bool) for texels in seen)]
        )
        faint = BACKGROUND + UNSEEN * (texel_colours - BACKGROUND)
        texel_colours = np.where(is_seen[:, None], texel_colours, faint)
    # projecting caps overlap the neighbours; otherwise the background shows between texels
    collection = LineCollection(
        [*segments], colors=texel_colours, linewidths=width, capstyle="projecting"
    )
    ax.add_collection(collection)
    return collection


def plot_view(
    ax: Axes,
    position: ArrayLike,
    angle: float,
    fov: float,
    distances: ArrayLike | None = None,
    reach: float = 1.0,
    colour: str = "w",
) -> Polygon:
    """Draws a camera's field of view: a wedge, or with ``distances`` the area that it sees. Returns
    the matplotlib patch.

    Args:
        position: (2,) of the camera in metres.
        angle: degrees from +x, anticlockwise.
        fov: degrees between the outermost rays.
        distances: (R,) metres along each ray, the leftmost first, as in ``Render.distances``;
            misses may be infinite.
        reach: metres, the length of the wedge and of rays that miss.
    """
    from matplotlib.patches import Polygon

    position = np.asarray(position, float)
    distances = np.full(33, reach) if distances is None else np.asarray(distances, float)
    distances = np.where(np.isfinite(distances), distances, reach)
    n_rays = len(distances)
    tangents = np.tan(np.radians(fov / 2)) * (n_rays - 1 - 2 * np.arange(n_rays)) / n_rays
    angles = np.radians(angle) + np.arctan(tangents)
    rim = position + distances[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
    ax.plot(*position, marker="o", markersize=4, color=colour)
    corners = np.concatenate([position[None], rim])
    polygon = Polygon(corners, facecolor=colour, alpha=0.15, linewidth=0)
    ax.add_patch(polygon)
    return polygon


def plot_goal(ax: Axes, position: ArrayLike, radius: float) -> Circle:
    """Draws a goal as a disc. Returns the matplotlib patch.

    Args:
        position: (2,) in metres.
        radius: metres within which the goal counts as reached.
    """
    from matplotlib.patches import Circle

    x, y = np.asarray(position, float)
    disc = Circle((x, y), radius, facecolor="C2", edgecolor="w", linewidth=0.8, zorder=3)
    ax.add_patch(disc)
    return disc
