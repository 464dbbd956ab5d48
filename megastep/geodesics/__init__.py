"""Shortest paths of an agent's disc between walls: :class:`PathGraph`, with its kernels."""

from megastep.geodesics.path_graph import CELL, MAX_GOALS, PathGraph

__all__ = ["CELL", "MAX_GOALS", "PathGraph"]
