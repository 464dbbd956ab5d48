"""Shortest paths of an agent's disc between walls, with their kernels."""

from megastep.geodesics.path_graph import (
    CELL,
    MAX_GOALS,
    Geodesics,
    PathGraph,
    draw_points,
    geodesics,
    largest_part,
    n_cells,
)

__all__ = ["CELL", "MAX_GOALS", "Geodesics", "PathGraph", "draw_points", "geodesics"]
__all__ += ["largest_part", "n_cells"]
