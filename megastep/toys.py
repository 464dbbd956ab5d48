"""The toy geometries under their short name: `from megastep import toys; toys.box()`."""

from megastep.geometries.toys import box, column

__all__ = ["box", "column"]
