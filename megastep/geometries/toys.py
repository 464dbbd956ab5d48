"""Geometries small enough to know by heart."""

from numbers import Real

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict

CORNER = 1.0  # metres; where the lower-left corner of every toy is


def _square(left, width):
    """The corners, (4, 2) anticlockwise, of a square from (left, left) to (left + width, left +
    width).
    """
    return left + width * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def _loop(corners):
    """The walls (P, 2, 2) between successive corners (P, 2), the last and the first included."""
    return np.stack([corners, np.roll(corners, -1, 0)], 1)


def _toy(rings, lights):
    walls = np.concatenate([_loop(ring) for ring in rings])
    return dotdict(
        id=0,
        walls=walls.astype(np.float32),
        lights=np.array(lights, np.float32),
        masks=geometry.masks(walls, [rings]),
        res=geometry.RES,
    )


def _checked_width(width, minimum):
    if not isinstance(width, Real) or not minimum <= width <= geometry.MAX_EXTENT - CORNER:
        raise ValueError(
            f"width={width!r} m is not allowed: take {minimum:g} to "
            f"{geometry.MAX_EXTENT - CORNER:g}"
        )


def box(width: float = 5) -> dotdict:
    """One square room `width` metres wide from (1, 1) and a light at its centre; by default walls
    run from 1 to 6.
    """
    _checked_width(width, 1)
    return _toy([_square(CORNER, width)], [[CORNER + width / 2] * 2])


def column(width: float = 5, pillar: float = 1) -> dotdict:
    """A box with a square pillar of side `pillar` metres in its middle, and a light in two opposite
    corners.
    """
    _checked_width(width, 2)
    if not isinstance(pillar, Real) or not 0 < pillar <= width - 1:
        raise ValueError(
            f"pillar={pillar!r} m does not fit a box {width} m wide: take above 0 and up to "
            f"{width - 1:g}"
        )
    rings = [_square(CORNER, width), _square(CORNER + (width - pillar) / 2, pillar)[::-1]]
    near = (width - pillar) / 4
    return _toy(rings, [[CORNER + near] * 2, [CORNER + width - near] * 2])
