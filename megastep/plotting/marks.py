"""What stands on a floor plan: agents and what they see, trails, goals, hits and objects."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.path import Path
from matplotlib.transforms import IdentityTransform
from numpy.typing import ArrayLike

from megastep.plotting.pictures import Area
from megastep.plotting.styles import AGENTS

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


def plot_object(
    ax: Area | Axes, shape: str, position: ArrayLike, angle: float, size: float, colour: ArrayLike
) -> None:
    """Draws a disc, a crate or a door, as :class:`megastep.engine.Objects` has them; the colour
    is (3,), sRGB.
    """
    area, position = Area.on(ax), np.asarray(position, float)
    fill, edge = tuple(np.asarray(colour, float)), area.style.colours.text
    ahead = size * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    aside = np.array([-ahead[1], ahead[0]])
    if shape == "disc":
        area.disc(position, size, OBJECTS, fill=fill, edge=edge, width=0.7, least=3)
    elif shape == "crate":
        corners = [ahead + aside, aside - ahead, -ahead - aside, ahead - aside]
        area.polygon(position + np.array(corners), OBJECTS, fill=fill, edge=edge, width=0.7)
    else:
        area.line([position - ahead, position + ahead], OBJECTS, colour=edge, width=4.6)
        area.line([position - ahead, position + ahead], OBJECTS, colour=fill, width=3.2)
