"""What stands on a floor plan: agents and what they see, trails, goals, hits and objects; and the
images that agents observe, as strips below it or on matplotlib's axes.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.path import Path
from matplotlib.transforms import IdentityTransform
from numpy.typing import ArrayLike

from megastep.colour import gamma_encode
from megastep.plotting.pictures import Area
from megastep.plotting.styles import AGENTS

STRIP = 0.09  # height of a row of pixels on matplotlib's axes, over its width
AGENT = 5.4  # points: radius at which an agent is drawn at least, 15 pixels across at 100 dpi
VIEWS, TRAIL, GOAL, OBJECTS, SHOTS, MARKS = range(1, 7)  # above floor and walls


def view_polygon(
    position: ArrayLike,
    angle: float,
    fov: float,
    distances: ArrayLike | None = None,
    reach: float = 1.0,
) -> np.ndarray:
    """Returns the corners (R + 1, 2) of what a camera sees, itself first: a wedge, or as far as
    ``distances`` say.

    Args:
        position: (2,) of the camera in metres.
        angle: degrees from +x, anticlockwise.
        fov: degrees between the outermost rays.
        distances: (R,) metres along each ray, the leftmost first, as in ``Render.distances``;
            misses may be infinite.
        reach: metres, the length of the wedge and of rays that miss.
    """
    position = np.asarray(position, float)
    distances = np.full(33, reach) if distances is None else np.asarray(distances, float)
    distances = np.where(np.isfinite(distances), distances, reach)
    n_rays = len(distances)
    tangents = np.tan(np.radians(fov / 2)) * (n_rays - 1 - 2 * np.arange(n_rays)) / n_rays
    angles = np.radians(angle) + np.arctan(tangents)
    rim = position + distances[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
    return np.concatenate([position[None], rim])


def plot_view(
    ax: Area | Axes,
    position: ArrayLike,
    angle: float,
    fov: float,
    distances: ArrayLike | None = None,
    reach: float = 1.0,
    colour: str = AGENTS[0],
) -> None:
    """Draws a camera's field of view; arguments as in :func:`view_polygon`."""
    corners = view_polygon(position, angle, fov, distances, reach)
    Area.on(ax).polygon(corners, VIEWS, fill=colour, alpha=0.22)


def plot_agent(
    ax: Area | Axes,
    position: ArrayLike,
    angle: float,
    radius: float,
    colour: str = AGENTS[0],
    label: str = "",
) -> None:
    """Draws an agent as a disc, at least 15 pixels wide at 100 dpi, with a beak where it looks."""
    area, position = Area.on(ax), np.asarray(position, float)
    ahead = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    aside = np.array([-ahead[1], ahead[0]])

    def beak(renderer) -> None:
        scale = area.transform.get_matrix()[0, 0]
        size = max(radius * scale, renderer.points_to_pixels(AGENT))
        centre = area.transform.transform(position)
        corners = centre + size * np.array(
            [0.75 * ahead + 0.75 * aside, 1.75 * ahead, 0.75 * ahead - 0.75 * aside]
        )
        path = Path(np.concatenate([corners, corners[:1]]), closed=True)
        area.draw_path(renderer, path, IdentityTransform(), colour, "#ffffff", 0.8)

    area.add(beak, MARKS)
    area.disc(position, radius, MARKS, fill=colour, edge="#ffffff", width=1.0, least=AGENT)
    if label:
        area.text(position, label, MARKS, size=7, colour="#ffffff", bold=True, align="centre")


def plot_trail(ax: Area | Axes, points: ArrayLike, colour: str = AGENTS[0]) -> None:
    """Draws where an agent was, (T, 2) metres, the newest last, fading into the past."""
    area, points = Area.on(ax), np.asarray(points, float)
    points = points[np.isfinite(points).all(1)]
    parts = np.array_split(np.arange(len(points)), min(12, max(len(points) // 2, 1)))
    for i, part in enumerate(parts):
        if len(part) and len(points) > 1:
            stretch = points[part[0] : part[-1] + 2]
            strength = (i + 1) / len(parts)
            area.line(
                stretch,
                TRAIL,
                colour=colour,
                width=1.4 + 1.2 * strength,
                alpha=0.15 + 0.75 * strength,
            )


def plot_goal(ax: Area | Axes, position: ArrayLike, radius: float) -> None:
    """Draws a goal at (2,) metres as a disc in a ring; it is reached within ``radius`` metres."""
    area = Area.on(ax)
    area.disc(position, 1.6 * radius, GOAL, fill="#1fa94c", alpha=0.25, least=9)
    area.disc(position, radius, GOAL, fill="#1fa94c", edge="#ffffff", width=1.2, least=5)


def plot_shot(ax: Area | Axes, start: ArrayLike, end: ArrayLike, colour: str) -> None:
    """Draws a hit as a line from who hits to whom it hits, (2,) metres each."""
    area = Area.on(ax)
    area.line([start, end], SHOTS, colour=colour, width=3.2, alpha=0.35)
    area.line([start, end], SHOTS, colour=colour, width=1.4)
    area.disc(end, 0, SHOTS, fill="#ffffff", alpha=0.0, edge=colour, width=1.6, least=AGENT + 3)


def plot_hold(ax: Area | Axes, holder: ArrayLike, held: ArrayLike, colour: str) -> None:
    """Draws a line from an agent to what it holds, (2,) metres each."""
    area = Area.on(ax)
    area.line([holder, held], SHOTS, colour=colour, width=2.2)
    area.disc(held, 0, SHOTS, fill=colour, edge="#ffffff", width=0.8, least=2.5)


def plot_object(
    ax: Area | Axes,
    shape: str,
    position: ArrayLike,
    angle: float,
    size: float,
    colour: ArrayLike,
    width: float = 1.0,
    edge: str | None = None,
) -> None:
    """Draws a disc, a crate, a ramp or a door, as :class:`megastep.engine.Objects` has them; the
    colour is (3,), sRGB. The width of a crate or ramp is a fraction of its length. A ramp has
    arrows towards its high side. ``edge``: colour of a bold outline, as of the team that locked it.
    """
    area, position = Area.on(ax), np.asarray(position, float)
    fill, line = tuple(np.asarray(colour, float)), 0.7 if edge is None else 2.8
    edge = edge or area.style.colours.text
    ahead = size * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    aside = np.array([-ahead[1], ahead[0]])
    if shape == "disc":
        area.disc(position, size, OBJECTS, fill=fill, edge=edge, width=line, least=3)
    elif shape == "crate":
        aside = width * aside
        corners = [ahead + aside, aside - ahead, -ahead - aside, ahead - aside]
        area.polygon(position + np.array(corners), OBJECTS, fill=fill, edge=edge, width=line)
    elif shape == "ramp":
        aside = width * aside
        corners = position + np.array([aside - ahead, ahead + aside, ahead - aside, -ahead - aside])
        area.polygon(corners, OBJECTS, fill=fill, alpha=0.5)
        area.line(corners, OBJECTS, colour=edge, width=max(line, 1.4))
        for step in (-0.3, 0.1, 0.5):
            tip = position + step * ahead
            arrow = [tip - 0.4 * ahead + 0.5 * aside, tip, tip - 0.4 * ahead - 0.5 * aside]
            area.line(arrow, OBJECTS, colour=area.style.colours.text, width=1.2)
    else:
        area.line([position - ahead, position + ahead], OBJECTS, colour=edge, width=4.6)
        area.line([position - ahead, position + ahead], OBJECTS, colour=fill, width=3.2)


# ---- Images ----


def plot_images(
    images: Mapping[str, ArrayLike],
    transpose: bool = False,
    aspect: float | None = None,
    axes: Sequence[Area | Axes] | np.ndarray | None = None,
    yaws: ArrayLike | None = None,
) -> np.ndarray:
    """Draws images side by side, one row of panels per name. Returns the axes, (names, images).
    Raises ValueError: an image has another shape.

    Args:
        images: name -> (..., C, H, W), as policies see them. One channel is shown in grey, 0 to 1.
            Three channels are linear light, and are gamma encoded here. All axes before the last
            three count the images of that name.
        transpose: the arrays are (..., H, W, C) instead, like ``Render.screen``.
        aspect: height of a panel over its width; by default pixels are square.
        axes: one per image, row by row: strips of :func:`panels`, or matplotlib's axes.
        yaws: degrees, the camera of each row of pixels, to label it with.
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
