"""Toy geometries: a box, and a box with a pillar."""

from numbers import Real

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict

CORNER = 1.0  # metres; x and y of the lower-left corner of every toy
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])  # anticlockwise


def _toy(rings, lights) -> dotdict:
    walls = np.concatenate([np.stack([ring, np.roll(ring, -1, 0)], 1) for ring in rings])
    return dotdict(
        id=0,
        walls=walls.astype(np.float32),
        lights=np.array(lights, np.float32),
        masks=geometry.masks(walls, [rings]),
        res=geometry.RES,
    )


def _validate(name, width, minimum, maximum) -> None:
    if not isinstance(width, Real) or not minimum <= width <= maximum:
        raise ValueError(f"{name}={width!r} must be from {minimum:g} to {maximum:g} m")


def box(width: float = 5) -> dotdict:
    """Returns a square room, `width` metres wide, with a light in its centre.

    Its lower-left corner is at (1, 1), so by default its walls run from 1 to 6.
    """
    _validate("width", width, 1, geometry.MAX_EXTENT - CORNER)
    return _toy([CORNER + width * SQUARE], [[CORNER + width / 2] * 2])


def column(width: float = 5, pillar: float = 1) -> dotdict:
    """Returns a box with a square pillar, `pillar` metres wide, in its middle, and a light in each
    of two opposite corners.
    """
    _validate("width", width, 2, geometry.MAX_EXTENT - CORNER)
    _validate("pillar", pillar, 0.01, width - 1)
    around = CORNER + (width - pillar) / 2 + pillar * SQUARE
    rings = [CORNER + width * SQUARE, around[::-1]]
    near = (width - pillar) / 4
    return _toy(rings, [[CORNER + near] * 2, [CORNER + width - near] * 2])
