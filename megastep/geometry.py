"""Geometries: the walls, lights and rooms of one floor plan, as a dotdict of numpy arrays.

| key | value |
| --- | --- |
| `id` | an integer |
| `walls` | (M, 2, 2) float32, (x, y) endpoints of M walls in metres, above 0 |
| `lights` | (K, 2) float32, (x, y) of K lights in metres, above 0 |
| `masks` | (H, W) int16 over square cells: -1 where a wall touches the cell, else the number of its
room (1, 2, ...), else 0 |
| `res` | the side of a cell in metres |
| `doors` | if it has any: (K, 2, 2) float32, the segments that would close its K doorways |

The lower-left corner of the masks is at (0, 0); row 0 is at the top. Further keys are allowed. In
this file `shape` is the (H, W) of the masks, and an index is an (i, j) pair of row and column.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from megastep.dotdict import dotdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "components",
    "centers",
    "contents",
    "display",
    "indices",
    "masks",
    "mirror_image",
    "validate_geometry",
]

G = TypeVar("G", bound=dict)

# Metres per cell, as in the original: coarse enough to be cheap, fine enough for a 0.6 m door.
RES = 0.2
MARGIN = 1.0  # metres of free cells beyond the furthest wall
MAX_EXTENT = 200.0  # metres; 1,000 x 1,000 cells of the default size
MAX_WALLS = 32_768  # about 150 times a dense home
MAX_LIGHTS = 4_096
MAX_CELLS = 4_000_000  # 8 MB of masks
MAX_ROOMS = 32_767  # the largest int16

# Cells. A wall this close to a cell's edge touches it; float32 is exact to 1e-5 m at 200 m.
TOLERANCE = 1e-4
# numpy's kinds of dtype, in words
NUMBERS = {"iuf": "numbers", "iu": "integers", "iub": "integers"}
CHUNK = 1_024  # walls rasterised at a time, to use at most about 100 MB of memory


def centers(indices: ArrayLike, shape: tuple[int, int], res: float = RES) -> np.ndarray:
    """Returns the centres of cells: (x, y) in metres, (..., 2) float32, for (i, j), (..., 2)."""
    indices = np.asarray(indices)
    i, j = indices[..., 0], indices[..., 1]
    return (np.stack([j + 0.5, shape[0] - i - 0.5], -1) * res).astype(np.float32)


def indices(coords: ArrayLike, shape: tuple[int, int], res: float = RES) -> np.ndarray:
    """Returns cells (i, j), (..., 2) int64, of points (x, y) in metres, also outside `shape`."""
    cells = np.floor(np.asarray(coords, np.float64) / res).astype(np.int64)
    return np.stack([shape[0] - 1 - cells[..., 1], cells[..., 0]], -1)


def _runs(lows, highs) -> tuple[np.ndarray, np.ndarray]:
    """Returns (the number of the range, the integer) for each integer of closed ranges."""
    counts = np.maximum(highs - lows + 1, 0)
    ranges = np.repeat(np.arange(len(lows)), counts)
    offsets = np.arange(len(ranges)) - np.repeat(np.cumsum(counts) - counts, counts)
    return ranges, offsets + lows[ranges]


def _touched(walls, shape) -> np.ndarray:
    """Returns cells that walls touch, (H, W) bool, row 0 at the bottom: runs in rows, summed."""
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


def _inside(rings, shape) -> np.ndarray:
    """Returns the cells whose centre an odd number of rings encloses, as `_touched` does."""
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
    flips = np.bincount(row * (width + 1) + column, minlength=height * (width + 1))
    return flips.reshape(height, width + 1).cumsum(1)[:, :width] % 2 == 1


def masks(
    walls: ArrayLike, rooms: Sequence, res: float = RES, extent: ArrayLike = (0, 0)
) -> np.ndarray:
    """Returns the masks of a geometry, (H, W) int16. Raises ValueError if a wall reaches beyond 200
    m.

    A room holds the cells whose centre it contains. Walls take every cell that they touch, even at
    its edge. Where rooms overlap, the later one wins.

    Args:
        walls: (M, 2, 2) metres.
        rooms: a polygon (P, 2) in metres per room, or a list of polygons of which all but the first
            are holes. The first room is number 1.
        res: the side of a cell in metres.
        extent: (x, y) in metres that the masks reach at least, where no wall is.
    """
    walls = np.asarray(walls, np.float64).reshape(-1, 2, 2)
    reach = np.concatenate([walls.reshape(-1, 2), np.reshape(extent, (1, 2))]).max(0)
    if not reach.max() <= MAX_EXTENT:
        raise ValueError(
            f"walls reach {reach.max():g} m, but the limit is {MAX_EXTENT:g} m; check the unit"
        )
    width, height = np.ceil((reach + MARGIN) / res - TOLERANCE).astype(int)

    result = np.zeros((height, width), np.int16)
    for number, room in enumerate(rooms, 1):
        rings = room if isinstance(room, (list, tuple)) and np.ndim(room[0]) == 2 else [room]
        rings = [np.asarray(ring, np.float64) / res for ring in rings]
        result[_inside(rings, result.shape)] = number
    for start in range(0, len(walls), CHUNK):
        result[_touched(walls[start : start + CHUNK] / res, result.shape)] = -1
    return np.ascontiguousarray(result[::-1])


def _array(g, key, kinds, shape) -> np.ndarray:
    """Returns entry `key` of a geometry, of one of numpy's `kinds` and of `shape`; None is any."""
    if key not in g:
        raise ValueError(f"has no '{key}'")
    value = np.asarray(g[key])
    if value.dtype.kind not in kinds:
        raise ValueError(f"'{key}' must hold {NUMBERS[kinds]}, but is of dtype {value.dtype}")
    if value.ndim != len(shape) or any(
        size not in (None, actual) for size, actual in zip(shape, value.shape)
    ):
        sizes = ", ".join("n" if size is None else str(size) for size in shape)
        raise ValueError(f"'{key}' must be of shape ({sizes}), but is of shape {value.shape}")
    return value


def _coordinates(g, key, shape, limit) -> np.ndarray:
    """Returns points as float32: finite, above 0, within the extent, and at most `limit`."""
    given = _array(g, key, "iuf", shape)
    if len(given) > limit:
        raise ValueError(f"has {len(given):,} {key}, but the limit is {limit:,}")
    if not np.isfinite(given).all():
        raise ValueError(f"'{key}' holds a NaN or infinity")
    with np.errstate(over="ignore"):  # an infinity is beyond the extent, too
        points = given.astype(np.float32)
    if not (points > 0).all():
        raise ValueError(
            f"'{key}' must be above 0, but reaches down to {given.min():g} m; shift the geometry"
        )
    if not (points <= MAX_EXTENT).all():
        raise ValueError(
            f"'{key}' reaches up to {given.max():g} m, but the limit is {MAX_EXTENT:g} m; check "
            f"the unit"
        )
    return points


def validate_geometry(g: G) -> G:
    """Returns a copy of a geometry with the documented dtypes and without walls of length 0. Raises
    ValueError if a number is not finite or not above 0, if there is no wall or no room, or if the
    geometry exceeds a limit at the head of this file.
    """
    walls = _coordinates(g, "walls", (None, 2, 2), MAX_WALLS)
    walls = walls[(walls[:, 0] != walls[:, 1]).any(-1)]
    if not len(walls):
        raise ValueError("has no wall longer than 0")
    lights = _coordinates(g, "lights", (None, 2), MAX_LIGHTS)
    cells = _array(g, "masks", "iub", (None, None))
    if cells.size > MAX_CELLS:
        raise ValueError(f"has masks of {cells.size:,} cells, but the limit is {MAX_CELLS:,}")
    if not (cells > 0).any():
        raise ValueError("has no room: no cell of 'masks' is above 0")
    if cells.min() < -1 or cells.max() > MAX_ROOMS:
        raise ValueError(
            f"'masks' must be from -1 to {MAX_ROOMS:,}, but is from {cells.min()} to {cells.max()}"
        )
    res = float(_array(g, "res", "iuf", ()))
    if not 0.01 <= res <= 10:
        raise ValueError(f"'res' must be from 0.01 to 10 m per cell, but is {res:g}")
    number = int(_array(g, "id", "iu", ()))
    parts: dict = dict(id=number, walls=walls, lights=lights, masks=cells.astype(np.int16), res=res)
    if "doors" in g:
        parts["doors"] = _coordinates(g, "doors", (None, 2, 2), MAX_WALLS)
    return cast(G, type(g)(g, **parts))


def mirror_image(g: dotdict) -> dotdict:
    """Returns a geometry with left and right swapped, with no keys but those of the head of this
    file. Raises ValueError if it is not valid, or a wall or light lies beyond its masks.
    """
    g = validate_geometry(dotdict(g))
    width = g.masks.shape[1] * g.res
    mirrored = {key: g[key].copy() for key in ("walls", "lights", "doors") if key in g}
    furthest = max(points[..., 0].max(initial=0) for points in mirrored.values())
    if furthest >= width:
        raise ValueError(
            f"geometry {g.id} has no mirror image: a wall or light is at x = {furthest:g} m, but "
            f"its masks end at {width:g} m"
        )
    for points in mirrored.values():
        points[..., 0] = width - points[..., 0]
    cells = np.ascontiguousarray(g.masks[:, ::-1])
    return validate_geometry(dotdict(id=g.id, masks=cells, res=g.res, **mirrored))


def contents(geometries: Sequence[dotdict]) -> Iterator[np.ndarray]:
    """Yields the arrays of walls and rooms of geometries, for the keys of caches."""
    for g in geometries:
        yield from (np.asarray(g.walls), np.asarray(g.masks), np.asarray(g.res))


def display(g: dotdict, ax: "Axes | None" = None) -> "Axes":
    """Draws a geometry: rooms tinted, walls black, lights yellow. Returns the matplotlib axes."""
    from matplotlib import collections, pyplot

    ax = pyplot.subplots(figsize=(6, 6))[1] if ax is None else ax
    height, width = g.masks.shape
    hues = pyplot.get_cmap("tab20")(np.linspace(0, 1, 20, endpoint=False))[:, :3]
    tints = 1 - 0.35 * (1 - hues[(np.maximum(g.masks, 1) * 2 - 2 + g.masks // 11) % 20])
    tints[g.masks == 0] = 1
    tints[g.masks < 0] = 0.92
    ax.imshow(tints, extent=(0, width * g.res, 0, height * g.res), interpolation="nearest")
    ax.add_collection(collections.LineCollection(g.walls, colors="k", linewidths=1))
    ax.scatter(*g.lights.T, c="gold", s=12, edgecolors="k", linewidths=0.3, zorder=3)
    ax.set(xlim=(0, width * g.res), ylim=(0, height * g.res))
    ax.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    return ax


def components(free: np.ndarray) -> tuple[np.ndarray, int]:
    """Returns labels (H, W) of 4-connected components of free cells, else 0, and their number."""
    from scipy import ndimage  # which takes a while to import

    labels, count = ndimage.label(free)  # pyright: ignore[reportGeneralTypeIssues]
    return labels, int(count)
