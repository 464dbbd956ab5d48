"""Short name of :mod:`megastep.geometries.toys`: `from megastep import toys; toys.box()`."""

from megastep.geometries.toys import box, column

__all__ = ["box", "column"]
