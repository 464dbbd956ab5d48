"""Draws a grid of MiniGrid."""

from typing import TYPE_CHECKING

import numpy as np

from megastep.envs.minigrid.tasks import LIBRARY

if TYPE_CHECKING:
    from megastep.plotting.pictures import Area

COLOURS = "#e5484d", "#30a46c", "#3e63dd", "#8e4ec6", "#f5d90a", "#8b8d98"
LAVA = "#ff8000"
KINDS = {LIBRARY.constants[name]: name for name in ("WALL", "OPEN_DOOR", "KEY", "BALL", "BOX")}
KINDS |= {LIBRARY.constants[name]: name for name in ("GOAL", "LAVA", "CLOSED_DOOR", "LOCKED_DOOR")}
ARROW = np.array([(-0.3, -0.3), (0.38, 0.0), (-0.3, 0.3)])  # of an agent that looks right


def draw(area: "Area", cells: np.ndarray, agent: np.ndarray, carried: int) -> None:
    """Draws cells (H, W), the agent (3,) and, in its corner, what it carries."""
    height, width = cells.shape
    area.fit(np.array([0, 0]), np.array([width, height]))
    theme = area.style.colours
    area.polygon(_square(width / 2, height / 2, width / 2, height / 2), fill=theme.floor)
    for y, x in np.ndindex(cells.shape):
        _cell(area, int(cells[y, x]), x + 0.5, height - y - 0.5, 1.0)
    x, y = agent[0] + 0.5, height - agent[1] - 0.5
    turn = -np.pi / 2 * agent[2]
    rotation = np.array([(np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))])
    area.polygon(ARROW @ rotation + (x, y), 3, fill=theme.text)
    if carried:
        _cell(area, carried, x + 0.3, y + 0.3, 0.45)


def _cell(area, cell, x, y, size) -> None:
    kind, colour = KINDS.get(cell & 15), COLOURS[(cell >> 4) % 6]
    half = size / 2
    if kind in ("WALL", "GOAL", "LAVA"):
        area.polygon(_square(x, y, half, half), 1, fill=LAVA if kind == "LAVA" else colour)
    elif kind in ("CLOSED_DOOR", "LOCKED_DOOR", "OPEN_DOOR"):
        area.polygon(_square(x, y, 0.9 * half, 0.9 * half), 1, edge=colour, width=2)
        if kind != "OPEN_DOOR":
            fill = dict(fill=colour, alpha=0.8 if kind == "LOCKED_DOOR" else 0.3)
            area.polygon(_square(x, y, 0.6 * half, 0.6 * half), 2, **fill)
    elif kind == "BALL":
        area.disc((x, y), 0.62 * half, 2, fill=colour)
    elif kind == "BOX":
        area.polygon(_square(x, y, 0.7 * half, 0.7 * half), 2, edge=colour, width=3)
        area.line([(x - 0.7 * half, y), (x + 0.7 * half, y)], 2, colour=colour, width=2)
    elif kind == "KEY":
        area.disc((x, y + 0.4 * half), 0.32 * half, 2, fill=colour)
        area.line([(x, y + 0.4 * half), (x, y - 0.7 * half)], 2, colour=colour, width=3)
        area.line(
            [(x, y - 0.6 * half), (x + 0.35 * half, y - 0.6 * half)], 2, colour=colour, width=3
        )


def _square(x, y, half_width, half_height) -> list[tuple[float, float]]:
    left, right, low, high = x - half_width, x + half_width, y - half_height, y + half_height
    return [(left, low), (right, low), (right, high), (left, high)]
