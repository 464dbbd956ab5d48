"""Draws drawings beside the geometries that they became."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.geometries.plans import outlines
from megastep.geometries.plans.outlines import Drawing

COLUMNS = 4  # pairs in a row
COLOURS = {"outdoors": "#cfe8cf", "rooms": "#f3e2b8", "walls": "#555555", "doors": "#d62728"}


def _draw(drawing, ax) -> None:
    """Draws a floor plan: rooms yellow, walls grey, doors red, openings that are closed blue."""
    floor = [drawing.floor] if drawing.floor is not None else []
    shapes = drawing._replace(rooms=[*floor, *drawing.rooms])
    for key, colour in COLOURS.items():
        for part in (part for shape in getattr(shapes, key) for part in outlines.polygons(shape)):
            rings = [np.array(r.coords) for r in (part.exterior, *part.interiors)]
            path = Outline.make_compound_path(*(Outline(r, closed=True) for r in rings))
            ax.add_patch(PathPatch(path, facecolor=colour, edgecolor="k", linewidth=0.3))
    for line in drawing.closed:
        ax.plot(*np.array(line.coords).T, color="#1f77b4", linewidth=2)
    ax.set_aspect("equal")
    ax.autoscale_view()


def write(
    path: Path, pairs: Sequence[tuple[str, Drawing | np.ndarray, dotdict]], columns: int = COLUMNS
) -> None:
    """Writes a sheet of (title, drawing or image, geometry) as an image. Raises OSError."""
    columns = min(columns, len(pairs))
    rows = -(-len(pairs) // columns)
    figure = Figure(figsize=(6.4 * columns, 3.4 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 2 * columns, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for (title, original, g), (left, right) in zip(pairs, axes.reshape(-1, 2)):
        if isinstance(original, np.ndarray):
            left.imshow(original)
        else:
            _draw(original, left)
        geometry.display(g, right)
        for line in g.get("doors", ()):
            right.plot(*line.T, color="#d62728", linewidth=1.5)
        left.set_title(textwrap.fill(title, 40), fontsize=8)
        right.set_title(f"{g.masks.max()} rooms, {len(g.walls)} walls", fontsize=8)
    figure.savefig(path, dpi=90)
