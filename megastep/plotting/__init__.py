"""Plots of environments: floor plans in their lit colours, and what agents see of them.

All functions take numpy arrays in metres, degrees and linear light, as a numpyified
``env.state(e)`` holds them; none needs a GPU. They draw on the axes that are given, or on a new
pyplot figure, which notebooks show. For ``plot_state``, :func:`panels` makes a figure that pyplot
does not know, so it need not be closed.

A agents, C channels, H rows and W columns, L lines, K lights, R rays.
"""

from megastep.colour import gamma_decode, gamma_encode
from megastep.plotting.figures import STRIP, panels, panels_beside, plot_level, rasterise
from megastep.plotting.images import camera_colours, plot_bars, plot_images
from megastep.plotting.plans import (
    BACKGROUND,
    EXPOSURE,
    UNSEEN,
    plot_goal,
    plot_lines,
    plot_scenery,
    plot_view,
)

__all__ = [
    "BACKGROUND",
    "EXPOSURE",
    "STRIP",
    "UNSEEN",
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
