"""The toy geometries under their short name: `from megastep import toys; toys.box()`."""

from .geometries.toys import box, column

__all__ = ["box", "column"]
