"""Quadrant rooms: a square room with a smaller one in a corner, as that of OpenAI's hide and seek
(Baker et al. 2020, https://arxiv.org/abs/1909.07528).

The inner room, a quarter of the floor, has one opening in half of all rooms, and one in each of its
two walls in the others. A seed gives the same bytes on every machine. Lengths in this file are in
millimetres.
"""

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.geometries.homes.portable_generator import PortableGenerator
from megastep.geometries.homes.walls import INDOORS, WALL, segments

COUNT = 5_000  # rooms, of seeds 0 to 4,999
START = 1_000  # where the lower-left corner is
THICK = 100  # of the inner walls
CORNER = 100  # of wall, at least, on either side of an opening


def generate(seed: int, width: float = 6.0, opening: float = 0.45) -> dotdict:
    """Returns the room of a seed. Key `inner` is the number of the inner room in the masks, which
    is at the lower right. Arguments are those of the source `quadrant`; lengths are rounded to a
    millimetre.
    """
    generator, wide, gap = PortableGenerator(seed), round(1000 * width), round(1000 * opening)
    half = wide // 2
    lows = [generator.between(CORNER, half - THICK - CORNER - gap) for _ in range(2)]
    single = generator.chance(0.5)
    has_opening = [True, True] if not single else [bool(generator.below(2))] * 2
    has_opening[1] ^= single
    # of columns and rows of cells, beside and in the walls and openings; row 0 is at the bottom
    right = half + THICK + lows[1]
    xs = np.array([0, half, half + THICK, right, right + gap, wide])
    ys = np.array([0, lows[0], lows[0] + gap, half - THICK, half, wide])
    cells = np.full((5, 5), INDOORS, np.int8)
    cells[:4, 1] = cells[3, 1:] = WALL
    if has_opening[0]:
        cells[1, 1] = INDOORS
    if has_opening[1]:
        cells[3, 3] = INDOORS
    xs, ys = (np.concatenate([[-1], lines, [wide + 1]]) for lines in (xs, ys))
    walls = (segments(xs, ys, np.pad(cells, 1, constant_values=WALL), INDOORS) + START) / 1000
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    outer, inner = corners * wide, corners * (wide - half) + (half, 0)
    doors = [
        [(half + THICK / 2, lows[0]), (half + THICK / 2, lows[0] + gap)],
        [(right, half - THICK / 2), (right + gap, half - THICK / 2)],
    ]
    lights = np.array([[0.25, 0.25], [0.25, 0.75], [0.75, 0.25], [0.75, 0.75]]) * wide
    return dotdict(
        id=seed,
        walls=walls.astype(np.float32),
        lights=((lights + START) / 1000).astype(np.float32),
        masks=geometry.masks(walls, [(outer + START) / 1000, (inner + START) / 1000]),
        res=geometry.RES,
        inner=2,
        doors=((np.array(doors)[has_opening] + START) / 1000).astype(np.float32),
    )
