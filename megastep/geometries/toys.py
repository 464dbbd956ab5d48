"""Toy geometries: a box, and a box with a pillar."""

from numbers import Real

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict

CORNER = 1.0  # metres; x and y of the lower-left corner of every toy


def _square(left, width) -> np.ndarray:
    """Returns the corners, (4, 2) anticlockwise, of a square with its lower-left corner at
    (left, left).
    """
    return left + width * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def _loop(corners) -> np.ndarray:
    """Returns the walls (P, 2, 2) of a closed loop of corners (P, 2)."""
    return np.stack([corners, np.roll(corners, -1, 0)], 1)


def _toy(rings, lights) -> dotdict:
    walls = np.concatenate([_loop(ring) for ring in rings])
    return dotdict(
        id=0,
        walls=walls.astype(np.float32),
        lights=np.array(lights, np.float32),
        masks=geometry.masks(walls, [rings]),
        res=geometry.RES,
    )


def _validate_width(width, minimum) -> None:
    maximum = geometry.MAX_EXTENT - CORNER
    if not isinstance(width, Real) or not minimum <= width <= maximum:
        raise ValueError(f"width={width!r} must be from {minimum:g} to {maximum:g} m")


def box(width: float = 5) -> dotdict:
    """Returns a square room, `width` metres wide, with a light in its centre.

    Its lower-left corner is at (1, 1), so by default its walls run from 1 to 6.
    """
    _validate_width(width, 1)
    return _toy([_square(CORNER, width)], [[CORNER + width / 2] * 2])


def column(width: float = 5, pillar: float = 1) -> dotdict:
    """Returns a box with a square pillar, `pillar` metres wide, in its middle, and a light in each
    of two opposite corners.
    """
    _validate_width(width, 2)
    if not isinstance(pillar, Real) or not 0 < pillar <= width - 1:
        raise ValueError(
            f"pillar={pillar!r} must be above 0 and at most {width - 1:g} m in a box of {width} m"
        )
    rings = [_square(CORNER, width), _square(CORNER + (width - pillar) / 2, pillar)[::-1]]
    near = (width - pillar) / 4
    return _toy(rings, [[CORNER + near] * 2, [CORNER + width - near] * 2])
