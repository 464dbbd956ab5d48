"""What a geometry is: the walls, lights and rooms of one floor plan, as a dotdict of numpy
arrays.

| key | value |
| --- | --- |
| `id` | an integer of its own |
| `walls` | (M, 2, 2) float32, the (x, y) endpoints of M walls in metres, all coordinates strictly
positive |
| `lights` | (K, 2) float32, the (x, y) of K lights in metres, strictly positive too |
| `masks` | (H, W) int16 over square cells: -1 where a wall touches, else the room's number 1, 2,
..., else 0 |
| `res` | the side of a cell in metres |

The masks' lower-left corner is at (0, 0) and row 0 is at the top. Further keys are welcome. `shape`
below is always the (H, W) of the masks, and an index an (i, j) pair of row and column.
"""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["centers", "checked", "display", "hashed", "indices", "masks"]

# Metres per cell; the original's, coarse enough to be cheap and fine enough for a 0.6 m door.
RES = 0.2
MARGIN = 1.0  # metres of free cells kept beyond the furthest wall
MAX_EXTENT = 200.0  # metres; 1,000 x 1,000 cells of the usual side
MAX_WALLS = 32_768  # some 150 times a dense home
MAX_LIGHTS = 4_096
MAX_CELLS = 4_000_000  # 8 MB of masks
MAX_ROOMS = 32_767  # what int16 numbers

# cells; a wall this near to a cell's edge touches the cell: float32 is good to 1e-5 m at 200 m
TOLERANCE = 1e-4
# numpy's kinds of dtype, in words
NUMBERS = {"iuf": "numbers", "iu": "integers", "iub": "integers"}
CHUNK = 1_024  # walls rasterised at a time, which bounds the memory at some 100 MB


def centers(indices: ArrayLike, shape: tuple[int, int], res: float = RES) -> np.ndarray:
    """The (x, y) centres in metres, (..., 2) float32, of the cells at `indices`, (..., 2) of (i,
    j).
    """
    indices = np.asarray(indices)
    i, j = indices[..., 0], indices[..., 1]
    return (np.stack([j + 0.5, shape[0] - i - 0.5], -1) * res).astype(np.float32)


def indices(coords: ArrayLike, shape: tuple[int, int], res: float = RES) -> np.ndarray:
    """The (i, j) indices, (..., 2) int64, of the cells that hold the points `coords`, (..., 2) of
    (x, y) in metres.

    The inverse of `centers`. Points outside of the masks give indices outside of `shape`.
    """
    cells = np.floor(np.asarray(coords, np.float64) / res).astype(np.int64)
    return np.stack([shape[0] - 1 - cells[..., 1], cells[..., 0]], -1)


def _runs(lows, highs):
    """Every integer of every closed range low..high (vectors of ints), and the number of the range
    each comes from.
    """
    counts = np.maximum(highs - lows + 1, 0)
    which = np.repeat(np.arange(len(lows)), counts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts) + lows[
        which
    ]


def _touched(walls, shape):
    """Cells, bool (H, W) with row 0 at the *bottom*, that some wall touches; walls (M, 2, 2) in
    units of cells.

    Each wall is cut into the rows it crosses; the piece inside a row covers a run of columns,
    marked by its two ends.
    """
    height, width = shape
    starts = np.take_along_axis(walls, walls[..., 1:].argsort(1), 1)  # lower end first
    (x0, y0), (x1, y1) = starts[:, 0].T, starts[:, 1].T
    lows = np.ceil(y0 - 1 - TOLERANCE).astype(np.int64).clip(0, height - 1)
    highs = np.floor(y1 + TOLERANCE).astype(np.int64).clip(0, height - 1)
    wall, row = _runs(lows, highs)

    rise = (y1 - y0)[wall]
    level = rise <= 2 * TOLERANCE
    rise = np.where(level, 1.0, rise)
    from_ = np.where(level, 0.0, (row - TOLERANCE - y0[wall]) / rise).clip(0, 1)
    to = np.where(level, 1.0, (row + 1 + TOLERANCE - y0[wall]) / rise).clip(0, 1)
    ends = x0[wall] + (x1 - x0)[wall] * np.stack([from_, to])
    first = np.ceil(ends.min(0) - 1 - TOLERANCE).astype(np.int64).clip(0, width)
    last = np.floor(ends.max(0) + TOLERANCE).astype(np.int64).clip(-1, width - 1)

    size = height * (width + 1)
    row = row * (width + 1)
    marks = np.bincount(row + first, minlength=size) - np.bincount(row + last + 1, minlength=size)
    return marks.reshape(height, width + 1).cumsum(1)[:, :width] > 0


def _inside(rings, shape):
    """Cells, bool (H, W) with row 0 at the bottom, whose centre an odd number of rings encloses;
    units of cells.
    """
    height, width = shape
    edges = np.concatenate([np.stack([ring, np.roll(ring, -1, 0)], 1) for ring in rings])
    edges = np.take_along_axis(edges, edges[..., 1:].argsort(1), 1)
    (x0, y0), (x1, y1) = edges[:, 0].T, edges[:, 1].T
    edge, row = _runs(
        np.ceil(y0 - 0.5).astype(np.int64).clip(0, height),
        np.ceil(y1 - 0.5).astype(np.int64).clip(0, height) - 1,
    )
    crossing = x0[edge] + (row + 0.5 - y0[edge]) * (x1 - x0)[edge] / (y1 - y0)[edge]
    column = np.ceil(crossing - 0.5).astype(np.int64).clip(0, width)
    flips = np.bincount(row * (width + 1) + column, minlength=height * (width + 1)).reshape(
        height, width + 1
    )
    return flips.cumsum(1)[:, :width] % 2 == 1


def masks(walls: ArrayLike, rooms: Sequence[Any], res: float = RES) -> np.ndarray:
    """The (H, W) int16 masks of a geometry.

    `walls` is (M, 2, 2) in metres. Each of `rooms` is a polygon, (P, 2) in metres, or a list of
    them of which the further ones are holes; the first room is number 1, and where rooms overlap
    the later one wins. A room holds the cells whose centre is in it; walls take every cell they
    touch, its edge included. Raises ValueError beyond 200 m.
    """
    walls = np.asarray(walls, np.float64).reshape(-1, 2, 2)
    extent = walls.reshape(-1, 2).max(0) if len(walls) else np.zeros(2)
    if not extent.max() <= MAX_EXTENT:
        raise ValueError(
            f"walls reach {extent.max():g} m, and {MAX_EXTENT:g} m is the limit; check their unit"
        )
    width, height = np.ceil((extent + MARGIN) / res - TOLERANCE).astype(int)

    result = np.zeros((height, width), np.int16)
    for number, room in enumerate(rooms, 1):
        rings = room if isinstance(room, (list, tuple)) and np.ndim(room[0]) == 2 else [room]
        result[_inside([np.asarray(ring, np.float64) / res for ring in rings], result.shape)] = (
            number
        )
    for start in range(0, len(walls), CHUNK):
        result[_touched(walls[start : start + CHUNK] / res, result.shape)] = -1
    return np.ascontiguousarray(result[::-1])


def _array(g, key, kinds, shape):
    """Entry `key` of a geometry as an array of one of the numpy `kinds` and of `shape`, where None
    is any length.
    """
    if key not in g:
        raise ValueError(f"has no '{key}'")
    value = np.asarray(g[key])
    if value.dtype.kind not in kinds:
        raise ValueError(f"'{key}' is of dtype {value.dtype}, and {NUMBERS[kinds]} were expected")
    if value.ndim != len(shape) or any(
        want is not None and have != want for have, want in zip(value.shape, shape)
    ):
        wanted = ", ".join("n" if want is None else str(want) for want in shape)
        raise ValueError(f"'{key}' has shape {value.shape}, and ({wanted}) was expected")
    return value


def _coordinates(g, key, shape, limit):
    """Points of a geometry as float32: finite, strictly positive, within the extent, at most
    `limit` rows of them.
    """
    points = _array(g, key, "iuf", shape)
    if len(points) > limit:
        raise ValueError(f"has {len(points):,} {key}, and the limit is {limit:,}")
    points = points.astype(np.float32)
    if not np.isfinite(points).all():
        raise ValueError(f"'{key}' holds a number that is not finite")
    if not (points > 0).all():
        raise ValueError(
            f"'{key}' reaches down to {points.min():g} m, and above 0 is allowed; shift the "
            f"geometry"
        )
    if not (points <= MAX_EXTENT).all():
        raise ValueError(
            f"'{key}' reaches up to {points.max():g} m, and the limit is {MAX_EXTENT:g} m; check "
            f"the unit"
        )
    return points


def checked(g: dict) -> Any:
    """A copy of geometry `g` with the documented dtypes and without walls of no length.

    Raises ValueError, saying what is wrong and what is allowed, unless it is finite, positive, has
    a wall and a room, and respects the limits at the head of this file.
    """
    walls = _coordinates(g, "walls", (None, 2, 2), MAX_WALLS)
    walls = walls[(walls[:, 0] != walls[:, 1]).any(-1)]
    if not len(walls):
        raise ValueError("has no wall of any length")
    lights = _coordinates(g, "lights", (None, 2), MAX_LIGHTS)
    cells = _array(g, "masks", "iub", (None, None))
    if cells.size > MAX_CELLS:
        raise ValueError(f"has masks of {cells.size:,} cells, and the limit is {MAX_CELLS:,}")
    if not (cells > 0).any():
        raise ValueError("has no room: no cell of 'masks' is above 0")
    if cells.min() < -1 or cells.max() > MAX_ROOMS:
        raise ValueError(
            f"'masks' holds {cells.min()} to {cells.max()}, and -1 to {MAX_ROOMS:,} is allowed"
        )
    res = float(_array(g, "res", "iuf", ()))
    if not 0.01 <= res <= 10:
        raise ValueError(f"'res' is {res:g} m per cell, and 0.01 to 10 is allowed")
    number = int(_array(g, "id", "iu", ()))
    return type(g)(g, id=number, walls=walls, lights=lights, masks=cells.astype(np.int16), res=res)


def hashed(geometries: Sequence[Any]) -> Any:
    """A SHA-256, to be updated further, of the walls and rooms of geometries."""
    key = hashlib.sha256()
    for g in geometries:
        for array in (g.walls, g.masks, np.asarray(g.res)):
            key.update(repr((array.shape, array.dtype)).encode() + array.tobytes())
    return key


def display(g: Any, ax: Any = None) -> Any:
    """Draws the plan of geometry `g`: rooms tinted, walls black, lights yellow. Returns the
    matplotlib axes.
    """
    from matplotlib import collections, pyplot

    ax = pyplot.subplots(figsize=(6, 6))[1] if ax is None else ax
    height, width = g.masks.shape
    hues = pyplot.get_cmap("tab20")(np.linspace(0, 1, 20, endpoint=False))[:, :3]
    tints = 1 - 0.35 * (1 - hues[(np.maximum(g.masks, 1) * 2 - 2 + g.masks // 11) % 20])
    tints[g.masks == 0] = 1
    tints[g.masks < 0] = 0.92
    ax.imshow(tints, extent=(0, width * g.res, 0, height * g.res), interpolation="nearest")
    ax.add_collection(collections.LineCollection(g.walls, colors="k", linewidths=1))
    ax.scatter(
        g.lights[:, 0], g.lights[:, 1], c="gold", s=12, edgecolors="k", linewidths=0.3, zorder=3
    )
    ax.set(
        xlim=(0, width * g.res),
        ylim=(0, height * g.res),
        aspect="equal",
        xlabel="x, m",
        ylabel="y, m",
    )
    return ax
