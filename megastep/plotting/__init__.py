"""Pictures of environments: floor plans, agents and what they see.

All functions take numpy arrays in metres, degrees and linear light, as a numpyified
``env.state(e)`` holds them; none needs a GPU. :func:`panels` makes a picture for ``plot_state``:
fast enough for films, and shown by notebooks. Its areas, and matplotlib's axes, are what the other
functions draw on. :func:`styled` changes theme, size and title of what is made inside it.

A agents, C channels, H rows and W columns, L lines, K lights, R rays.
"""

import importlib
from typing import TYPE_CHECKING, Any

from megastep.colour import gamma_decode, gamma_encode
from megastep.plotting.images import STRIP, camera_colours, plot_bars, plot_images
from megastep.plotting.marks import (
    plot_agent,
    plot_goal,
    plot_object,
    plot_shot,
    plot_trail,
    plot_view,
    view_polygon,
)
from megastep.plotting.plans import plot_scenery, wall_colours
from megastep.plotting.styles import AGENTS, Style, current, styled

if TYPE_CHECKING:
    from megastep.plotting.pictures import (
        Area,
        Picture,
        captioned,
        encoded,
        framed,
        panels,
        plot_level,
        rasterise,
        side_by_side,
    )

__all__ = [
    "AGENTS",
    "STRIP",
    "Area",
    "Picture",
    "Style",
    "camera_colours",
    "captioned",
    "encoded",
    "framed",
    "current",
    "gamma_decode",
    "gamma_encode",
    "panels",
    "plot_agent",
    "plot_bars",
    "plot_goal",
    "plot_images",
    "plot_level",
    "plot_object",
    "plot_scenery",
    "plot_shot",
    "plot_trail",
    "plot_view",
    "rasterise",
    "side_by_side",
    "styled",
    "view_polygon",
    "wall_colours",
]


def __getattr__(name: str) -> Any:
    """Imports what needs matplotlib, half a second, when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("megastep.plotting.pictures"), name)
