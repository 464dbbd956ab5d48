"""Drawing for people: plans in their lit colours, what an agent can see of them, and the strips
its camera delivers.

Everything here takes numpy arrays in metres, degrees and linear light: a numpyified
``env.state(e)`` holds them, and no GPU is needed. Drawn on axes where some are given, else on a new
pyplot figure, which notebooks show; :func:`panels` makes a figure that pyplot knows nothing of, for
``plot_state``.

A agents, C channels, H and W rows and columns, L lines, K lights, R rays.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from megastep.colour import gamma_decode, gamma_encode

__all__ = [
    "camera_colours",
    "gamma_decode",
    "gamma_encode",
    "panels",
    "panels_beside",
    "plot_bars",
    "plot_goal",
    "plot_images",
    "plot_level",
    "plot_lines",
    "plot_scenery",
    "plot_view",
    "rasterise",
]

# grey of the plan, in sRGB: dark, because the walls are drawn in the light that falls on them
BACKGROUND = 0.12
# plans are drawn brighter than cameras see them: most walls get well under half of full light
EXPOSURE = 2.5
UNSEEN = 0.2  # how far texels that have not been seen rise from the background
STRIP = 0.09  # height of a strip over its width


def panels(
    n_strips: int = 0, width: float = 6.0, title: str | None = None, n_cameras: int = 1
) -> tuple[Any, Any, list]:
    """A figure with a square for the plan and ``n_strips`` strips under it, each as high as
    ``n_cameras`` rows of pixels: (figure, plan axes, list of strip axes).

    ``width`` is in inches, at 100 pixels per inch. The figure is not pyplot's, so nothing has to be
    closed.
    """
    from matplotlib.figure import Figure

    margin, gap = 0.55, 0.5  # inches: about the plan, and below a strip for its labels
    inner = width - 2 * margin
    strip = STRIP * inner * n_cameras
    height = 2 * margin + inner + n_strips * (strip + gap)
    figure = Figure(figsize=(width, height), dpi=100)

    def axes(bottom, tall):
        return figure.add_axes((margin / width, bottom / height, inner / width, tall / height))

    plan = axes(height - margin - inner, inner)
    if title is not None:
        plan.set_title(title)
    return (
        figure,
        plan,
        [axes(gap + (n_strips - 1 - i) * (strip + gap), strip) for i in range(n_strips)],
    )


def panels_beside(
    n_rows: int, n_strips: int, width: float = 12.0, title: str | None = None
) -> tuple[Any, Any, list]:
    """A figure with a square for the plan and beside it ``n_rows`` rows of ``n_strips`` strips, one
    above the other: (figure, plan axes, list of lists of strip axes). Else as :func:`panels`.
    """
    from matplotlib.figure import Figure

    margin, head, gap = 0.55, 0.3, 0.08  # inches: about the plan, above a row, between its strips
    inner = width / 2 - 1.5 * margin
    row = max(inner / n_rows, head + n_strips * (0.18 + gap))  # inches
    height = 2 * margin + n_rows * row
    strip = (row - head) / n_strips - gap
    figure = Figure(figsize=(width, height), dpi=100)

    def axes(left, bottom, tall):
        return figure.add_axes((left / width, bottom / height, inner / width, tall / height))

    plan = axes(margin, (height - inner) / 2, inner)
    if title is not None:
        plan.set_title(title)
    return (
        figure,
        plan,
        [
            [
                axes(
                    width / 2 + margin / 2,
                    height - margin - r * row - head - (k + 1) * strip - k * gap,
                    strip,
                )
                for k in range(n_strips)
            ]
            for r in range(n_rows)
        ],
    )


def plot_level(ax: Any, level: float) -> None:
    """Draws a number from 0 to 1 as a bar along the upper edge of ``ax``, the redder the less."""
    from matplotlib.patches import Rectangle

    bar = dict(transform=ax.transAxes, clip_on=False, linewidth=0)
    ax.add_patch(Rectangle((0, 1.02), 1, 0.12, facecolor="0.8", **bar))
    ax.add_patch(Rectangle((0, 1.02), level, 0.12, facecolor=(1 - level, 0.7 * level, 0), **bar))


def plot_images(
    images: Mapping[str, ArrayLike],
    transpose: bool = False,
    aspect: float | None = None,
    axes: Any = None,
    yaws: ArrayLike | None = None,
) -> np.ndarray:
    """Draws images side by side, a row of panels for each name. Returns the axes, (names, images).

    Args:
        images: dict of arrays (..., C, H, W) as policies see them, of 1 channel (shown in grey, 0
            to 1) or 3 (linear light, gamma encoded here). All axes before the last three are
            further images of that name.
        transpose: the arrays are (..., H, W, C) instead, like ``Render.screen``.
        aspect: height of a panel over its width; by default such that pixels are square.
        axes: as many axes as there are images in all, row by row.
        yaws: degrees, of the camera that each row of pixels is of, to label it.
    Raises ValueError for other shapes.
    """
    stacks = {name: _stack(name, image, transpose) for name, image in images.items()}
    shape = len(stacks), max(map(len, stacks.values()), default=0)
    if not all(shape):
        raise ValueError(
            "plot_images was given no images; it needs a dict of arrays with at least one each"
        )
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.subplots(
            *shape, squeeze=False, layout="constrained", figsize=(6 * shape[1], 1.5 * shape[0])
        )[1]
    axes = np.asarray(axes, dtype=object).reshape(shape)
    for row, (name, stack) in zip(axes, stacks.items(), strict=True):
        for i, ax in enumerate(row):
            if i < len(stack):
                _plot_image(ax, stack[i], name if len(stack) == 1 else f"{name} {i}", aspect, yaws)
            else:
                ax.set_axis_off()
    return axes


def _stack(name, image, transpose):
    """(n, H, W, C) floats in [0, 1], ready to show."""
    image = np.asarray(image, np.float32)
    if image.ndim >= 3 and not transpose:
        image = np.moveaxis(image, -3, -1)
    if image.ndim < 3 or image.shape[-1] not in (1, 3):
        wanted = "(..., H, W, C)" if transpose else "(..., C, H, W)"
        raise ValueError(
            f"image '{name}' must have shape {wanted} with 1 or 3 channels C, but with transpose="
            f"{bool(transpose)} its shape {np.shape(image)} is read as one of other channels"
        )
    image = np.clip(np.nan_to_num(image), 0, 1).reshape(-1, *image.shape[-3:])
    return gamma_encode(image) if image.shape[-1] == 3 else image


def _plot_image(ax, image, title, aspect, yaws):
    options = dict(cmap="gray", vmin=0, vmax=1) if image.shape[-1] == 1 else {}
    ax.imshow(
        image.squeeze(-1) if image.shape[-1] == 1 else image,
        interpolation="nearest",
        aspect="equal" if aspect is None else "auto",
        **options,
    )
    ax.set_box_aspect(aspect)
    ax.set_title(title, fontsize="small", loc="left", pad=2)
    ax.set_xlabel("pixel, from left to right", fontsize="x-small", labelpad=1)
    ax.tick_params(labelsize="x-small")
    ax.set_yticks([])
    if yaws is not None and len(yaws) > 1:
        ax.set_yticks(range(len(yaws)), [f"{yaw:g}°" for yaw in yaws])
        for label, colour in zip(ax.get_yticklabels(), camera_colours(len(yaws)), strict=True):
            label.set_color(colour)


def camera_colours(n_cameras: int) -> list[str]:
    """What each camera's view and its row of pixels are marked with: white for a single one."""
    return ["w"] if n_cameras == 1 else [f"C{camera}" for camera in range(n_cameras)]


def plot_bars(names: Sequence[str], values: ArrayLike, ax: Any = None) -> Any:
    """Draws named numbers between -1 and 1 as bars: ``values`` (A, len(names)), a group per agent.
    Returns the axes, those given or of a new figure.
    """
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.subplots(figsize=(3, 1.5), layout="constrained")[1]
    values = np.asarray(values, np.float32).reshape(-1, len(names))
    width = 0.8 / len(values)
    for a, row in enumerate(values):
        ax.bar(np.arange(len(names)) + width * (a - (len(values) - 1) / 2), row, width)
    ax.set_xticks(np.arange(len(names)), names, fontsize="x-small")
    ax.set_ylim(-1, 1)
    return ax


def plot_goal(ax: Any, position: ArrayLike, radius: float) -> Any:
    """Draws a goal at ``position`` (2,) that is reached within ``radius``, both in metres. Returns
    the matplotlib patch.
    """
    from matplotlib.patches import Circle

    disc = Circle(position, radius, facecolor="C2", edgecolor="w", linewidth=0.8, zorder=3)
    return ax.add_patch(disc)


def plot_lines(
    ax: Any,
    lines: ArrayLike,
    colours: Sequence[ArrayLike],
    seen: Sequence[ArrayLike] | None = None,
    exposure: float = EXPOSURE,
    width: float = 2.5,
) -> Any:
    """Draws lines texel by texel on ``ax``. Returns the matplotlib LineCollection.

    Args:
        lines: (L, 2, 2) endpoints in metres.
        colours: one (w, 3) array per line, its w lit texels in linear light.
        seen: one (w,) array of bools per line; texels that are False are drawn faintly. All are
            seen by default.
        exposure: what the light is multiplied with.
        width: of the lines, in points.
    """
    from matplotlib.collections import LineCollection

    lines = np.asarray(lines, np.float32).reshape(-1, 2, 2)
    widths = np.array([len(texels) for texels in colours], int)
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
    shown = gamma_encode(np.clip(exposure * light, 0, 1))
    if seen is not None:
        seen = np.concatenate([np.zeros(0, bool), *(np.asarray(texels, bool) for texels in seen)])
        shown = np.where(seen[:, None], shown, BACKGROUND + UNSEEN * (shown - BACKGROUND))
    # Caps reach into the neighbours, or the background would shine through between texels.
    return ax.add_collection(
        LineCollection(segments, colors=shown, linewidths=width, capstyle="projecting")
    )


def plot_scenery(
    lines: ArrayLike,
    colours: Sequence[ArrayLike],
    lights: ArrayLike | None = None,
    seen: Sequence[ArrayLike] | None = None,
    ax: Any = None,
) -> Any:
    """Draws one environment from above: its lines in their lit colours, and its lights. Returns
    the axes.

    Args: ``lines``, ``colours`` and ``seen`` as in :func:`plot_lines`; ``lights`` (K, 2 or more), x
    and y first.
    """
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.subplots(figsize=(6, 6))[1]
    ax.set_facecolor(str(BACKGROUND))
    plot_lines(ax, lines, colours, seen)
    if lights is not None and len(lights):
        ax.scatter(
            np.asarray(lights)[:, 0],
            np.asarray(lights)[:, 1],
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


def plot_view(
    ax: Any,
    position: ArrayLike,
    angle: float,
    fov: float,
    distances: ArrayLike | None = None,
    reach: float = 1.0,
    colour: str = "w",
) -> Any:
    """Draws where a camera looks: a wedge, or with ``distances`` the area it sees. Returns the
    matplotlib patch.

    Args:
        position: (2,) of the camera in metres.
        angle: degrees from +x, anticlockwise.
        fov: degrees between the outermost rays.
        distances: (R,) metres along each ray, the leftmost first, as in ``Render.distances``;
            misses may be infinite.
        reach: metres; how far the wedge goes, and misses.
    """
    from matplotlib.patches import Polygon

    position = np.asarray(position, float)
    distances = np.full(33, reach) if distances is None else np.asarray(distances, float)
    distances = np.where(np.isfinite(distances), distances, reach)
    rays = len(distances)
    left = np.tan(np.radians(fov / 2)) * (rays - 1 - 2 * np.arange(rays)) / rays
    angles = np.radians(angle) + np.arctan(left)
    rim = position + distances[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
    ax.plot(*position, marker="o", markersize=4, color=colour)
    return ax.add_patch(
        Polygon(np.concatenate([position[None], rim]), facecolor=colour, alpha=0.15, linewidth=0)
    )


def rasterise(figure: Any) -> np.ndarray:
    """A figure as an (H, W, 3) uint8 array, drawn by Agg whatever canvas it has."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
