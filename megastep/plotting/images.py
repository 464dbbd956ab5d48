"""Images that agents observe, as strips below a plan or on matplotlib's axes."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from megastep.colour import gamma_encode
from megastep.plotting.pictures import Area
from megastep.plotting.styles import AGENTS

STRIP = 0.09  # height of a row of pixels on matplotlib's axes, over its width


def plot_images(
    images: Mapping[str, ArrayLike],
    transpose: bool = False,
    aspect: float | None = None,
    axes: Sequence[Area | Axes] | np.ndarray | None = None,
    yaws: ArrayLike | None = None,
) -> np.ndarray:
    """Draws images side by side, one row of panels per name. Returns the axes, (names, images).

    Args:
        images: name -> (..., C, H, W), as policies see them. One channel is shown in grey, 0 to 1.
            Three channels are linear light, and are gamma encoded here. All axes before the last
            three count the images of that name.
        transpose: the arrays are (..., H, W, C) instead, like ``Render.screen``.
        aspect: height of a panel over its width; by default pixels are square.
        axes: one per image, row by row: strips of :func:`panels`, or matplotlib's axes.
        yaws: degrees, the camera of each row of pixels, to label it with.

    Raises:
        ValueError: an image has another shape.
    """
    stacks = {name: _stack(name, image, transpose) for name, image in images.items()}
    shape = len(stacks), max(map(len, stacks.values()))
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.subplots(
            *shape, squeeze=False, layout="constrained", figsize=(6 * shape[1], 1.5 * shape[0])
        )[1]
    axes = np.asarray(axes, dtype=object).reshape(shape)
    for row, (name, stack) in zip(axes, stacks.items(), strict=True):
        for i, ax in enumerate(row):
            if i < len(stack) and hasattr(ax, "strip_label"):
                _plot_strip(ax, stack[i], name, i if len(stack) > 1 else None, yaws)
            elif i < len(stack):
                _plot_image(ax, stack[i], name if len(stack) == 1 else f"{name} {i}", aspect, yaws)
            else:
                ax.set_axis_off()
    return axes


def _stack(name, image, transpose) -> np.ndarray:
    """Returns (n, H, W, C) floats in [0, 1], ready to show."""
    image, shape = np.asarray(image, np.float32), np.shape(image)
    if image.ndim >= 3 and not transpose:
        image = np.moveaxis(image, -3, -1)
    if image.ndim < 3 or image.shape[-1] not in (1, 3):
        layout = "(..., H, W, C)" if transpose else "(..., C, H, W)"
        raise ValueError(
            f"image '{name}' must have shape {layout} with 1 or 3 channels C if transpose="
            f"{bool(transpose)}, but its shape is {shape}"
        )
    image = np.clip(np.nan_to_num(image), 0, 1).reshape(-1, *image.shape[-3:])
    return gamma_encode(image) if image.shape[-1] == 3 else image


def _plot_strip(area, image, name, agent, yaws) -> None:
    area.image(np.broadcast_to(image, (*image.shape[:2], 3)))
    label, theme, middle = area.strip_label, area.style.colours, area.height / 2
    if agent is not None:
        label.text((0, middle), f"{agent}", size=10, bold=True, colour=AGENTS[agent % len(AGENTS)])
    n_rows = 1 if yaws is None else len(yaws)
    label.text((0.16 * (agent is not None), middle), name, size=9, colour=theme.faint)
    for row, colour in enumerate(camera_colours(n_rows) if n_rows > 1 else ()):
        y = area.height * (1 - (row + 0.5) / n_rows)
        degrees = f"{np.asarray(yaws)[row]:g}°"
        label.text((label.width - 0.04, y), degrees, size=7, colour=colour, align="right")


def _plot_image(ax, image, title, aspect, yaws) -> None:
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
    """Returns a colour per camera, for its view on the plan and its row of pixels."""
    return [AGENTS[camera % len(AGENTS)] for camera in range(n_cameras)]
