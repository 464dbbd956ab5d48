"""Reads maps of robots: occupancy grids of ROS, a `.yaml` with its image, and black-and-white
images, in which white is floor.
"""

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
import yaml
from contourpy import contour_generator
from PIL import Image
from scipy import ndimage
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from megastep.geometries.plans import outlines
from megastep.geometries.plans.outlines import Drawing

MAX_PIXELS = 16_000_000  # 200 m x 200 m of 5 cm
MAX_YAML = 1 << 16  # bytes
FORMATS = ("PNG", "PPM", "BMP", "JPEG", "TIFF")
TOLERANCE = 0.02  # metres by which contours are simplified, and at least STEP of a pixel
STEP = 0.6
SPECKLE = 0.03  # m2; smaller objects on the floor, and smaller holes in walls, are no walls
BUMP = 2  # cells that differ from most around them and may be a bump; more are a thin wall
MAX_SIDES = 400_000  # of cells, between floor and what is not
MAX_ANGLE = 5.0  # degrees by which a map is straightened
MIN_ANGLE = 0.15
ROUGH = 0.05  # metres by which contours are simplified to find their angle
#: Grey levels of the picture of a map, and the colours of cells that are changed.
FREE, UNKNOWN, WALL = 254, 205, 0
TO_FLOOR, TO_WALL = (214, 39, 40), (31, 119, 180)
ANY = np.ones((3, 3), np.uint8)  # cells that touch, also at a corner
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)  # at a side
TRUE, FALSE = ("true", "yes", "on"), ("false", "no", "off")
DEFAULTS = {"occupied_thresh": "0.65", "free_thresh": "0.196", "negate": "0", "mode": "trinary"}


class Map(NamedTuple):
    """A map: (H, W) cells with row 0 at the top, free, unknown or neither, which is a wall."""

    free: np.ndarray
    unknown: np.ndarray
    resolution: float  # metres per cell
    warnings: list[str]


def load(path: Path, metres_per_pixel: float | None = None) -> Map:
    """Returns the map of a ROS `.yaml`, or of an image and its metres per pixel. ValueError."""
    if path.suffix.lower() not in (".yaml", ".yml"):
        if metres_per_pixel is None:
            raise ValueError("an image needs metres_per_pixel=, such as 0.02")
        shade, alpha = _image(path)
        free = shade * alpha + 1 - alpha >= 128 / 255  # what is transparent is floor
        return Map(free, np.zeros_like(free), metres_per_pixel, [])
    if path.stat().st_size > MAX_YAML:
        raise ValueError(f"it has more than {MAX_YAML:,} bytes")
    try:
        given = yaml.load(path.read_bytes(), yaml.BaseLoader)  # all words
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ValueError("it is no YAML") from error
    if not isinstance(given, dict) or not isinstance(given.get("image"), str):
        raise ValueError("it has no 'image'; a map of ROS has image, resolution and origin")
    given = DEFAULTS | given
    word = str(given["negate"]).lower()
    is_negative = word in TRUE or word not in FALSE and _number(given, "negate") != 0
    free_below, wall_above = _number(given, "free_thresh"), _number(given, "occupied_thresh")
    mode = str(given["mode"]).lower()
    if mode not in ("trinary", "scale", "raw"):
        raise ValueError(f"its mode is {mode[:20]!r}, but trinary, scale and raw are allowed")
    places = path.parent / given["image"], path.parent / Path(given["image"]).name
    shade, alpha = _image(next((place for place in places if place.is_file()), places[0]))
    if mode == "trinary" and alpha.min() < 1:  # map_server takes alpha for a channel of colour
        shade = (3 * shade + alpha) / 4
    occupied = shade if is_negative else 1 - shade
    unknown = alpha < (1 if mode == "scale" else 1e-9)
    if mode == "raw":
        occupied = np.rint(shade * 255) / 100
        unknown |= occupied > 1
    else:
        is_free, is_wall = occupied < free_below, occupied > wall_above
        span = max(wall_above - free_below, 1e-9)
        occupied = np.select([is_wall, is_free], [1, 0], (occupied - free_below) / span)
        if mode == "trinary":
            unknown |= ~is_free & ~is_wall
            if free_below == 0.25:  # as Nav2 wrote until 2025, where 205 was unknown
                unknown |= np.rint(shade * 255) == UNKNOWN
    guessed = ((occupied > 0) & (occupied < 1) & ~unknown).sum()
    text = f"{guessed:,} cells are neither free nor occupied; those from 50 % are walls"
    resolution = float(metres_per_pixel or _number(given, "resolution"))
    return Map((occupied < 0.5) & ~unknown, unknown, resolution, [text] * bool(guessed))


def _number(given, key) -> float:
    try:
        return float(given.get(key, ""))
    except (TypeError, ValueError):
        raise ValueError(f"its {key} is {str(given.get(key))[:40]!r}, no number") from None


def _image(path) -> tuple[np.ndarray, np.ndarray]:
    """Returns the shades of an image, (H, W) from 0 for black to 1 for white, and their alpha."""
    if not path.is_file():
        raise ValueError(f"there is no image {str(path)!r}")
    try:
        with Image.open(io.BytesIO(path.read_bytes()), formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(
                    f"its image has {image.width * image.height:,} pixels, but the limit is "
                    f"{MAX_PIXELS:,}"
                )
            if image.mode.startswith("I"):  # 16 bits
                values = np.asarray(image, np.float32) / 65_535
                return values.clip(0, 1), np.ones_like(values)
            if image.mode in ("1", "L"):
                values = np.asarray(image.convert("L")) / 255
                return values, np.broadcast_to(1.0, values.shape)
            values = np.asarray(image.convert("RGBA"))
            return values[..., :3].mean(-1) / 255, values[..., 3] / 255
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"its image {path.name!r} cannot be read, or is cut short") from error


def read(grid: Map) -> tuple[Drawing, np.ndarray, list[str]]:
    """Returns the drawing of a map, straightened and without speckles, a picture (H, W, 3) of what
    was changed, and warnings. Raises ValueError.
    """
    resolution = grid.resolution
    if not np.isfinite(resolution) or resolution <= 0:
        raise ValueError(f"its resolution is {resolution:g} m, but must be above 0")
    if not grid.free.any():
        raise ValueError("the map is all walls: no cell is free")
    extent = max(grid.free.shape) * resolution
    if extent > 10 * outlines.MAX_EXTENT:
        raise ValueError(f"the map is {extent:,.0f} m long; check the resolution")
    free, warnings = _cleaned(grid.free, resolution), [*grid.warnings]
    picture = np.select([grid.free, grid.unknown], [FREE, UNKNOWN], WALL).astype(np.uint8)
    picture = picture[..., None].repeat(3, -1)
    changes = (free & ~grid.free, TO_FLOOR, "floor"), (~free & grid.free, TO_WALL, "wall")
    for cells, colour, kind in changes:
        picture[cells] = colour
        if n := cells.sum():
            warnings.append(f"{n:,} cells ({n * resolution**2:.2f} m2) of specks are {kind} now")
    on_border = np.concatenate([free[0], free[-1], free[:, 0], free[:, -1]])
    is_drawing = bool(on_border.any()) and not grid.unknown.any()
    floor = _area(free, resolution)
    if is_drawing:  # its walls, which are connected where they touch at a corner
        floor = shapely.box(*floor.bounds).difference(floor)
        floor = floor.buffer(resolution / 50, **outlines.MITRE)
    angle = skew(floor)
    if MIN_ANGLE < abs(angle) <= MAX_ANGLE:
        floor = affinity.rotate(floor, -angle, origin=(0, 0))
        warnings.append(f"the map is turned by {-angle:.1f} degrees, so that its walls are level")
    floor = shapely.simplify(floor, max(TOLERANCE, STEP * resolution))
    if is_drawing:
        return outlines.enclosed(outlines.polygons(floor), []), picture, warnings
    edge = ndimage.binary_dilation(free, ANY) & grid.unknown
    if (length := edge.sum() * resolution) > 0.5:
        warnings.append(f"about {length:.1f} m of the floor's edge is unknown, and is a wall now")
    pieces = outlines.polygons(floor)
    parts = [part for part in pieces if part.area >= outlines.MIN_AREA]
    if not parts:
        raise ValueError(f"no floor of {outlines.MIN_AREA:g} m2 is free; check the resolution")
    if lost := len(pieces) - len(parts):
        area = sum(part.area for part in pieces) - sum(part.area for part in parts)
        warnings.append(f"{lost} pieces of floor ({area:.1f} m2) under 1 m2 are left out")
    outlines.check_extent(parts)
    floor = shapely.union_all(parts)
    return Drawing([], outlines.rooms_of(floor), [], [], floor), picture, warnings


def _cleaned(free, resolution) -> np.ndarray:
    """Returns the free cells without speckles, bumps and dents; thin walls and corners stay."""
    same = [
        np.where(free, n, around.sum() - n)
        for around in (ANY, CROSS)
        for n in [ndimage.convolve(free.astype(np.uint8), around, mode="nearest")]
    ]
    free = free ^ (_small(same[0] <= 4, BUMP) & (same[1] <= 2))
    n_cells = max(2, round(SPECKLE / resolution**2))
    free = free | _small(~free, n_cells)
    return free & ~_small(free, n_cells, CROSS)


def _small(cells, n_cells, touching: np.ndarray = ANY) -> np.ndarray:
    """Returns the components of cells (H, W) that are at most `n_cells` large."""
    labels, _ = ndimage.label(cells, touching)  # pyright: ignore[reportGeneralTypeIssues]
    is_small = np.bincount(labels.ravel()) <= n_cells
    is_small[0] = False
    return is_small[labels]


def _area(cells, resolution) -> BaseGeometry:
    """Returns the area of cells (H, W) in metres. Touching at a corner does not connect them."""
    heights = np.pad(cells, 1).astype(np.float32)
    n_sides = sum((np.diff(heights, axis=axis) != 0).sum() for axis in (0, 1))
    if n_sides > MAX_SIDES:
        raise ValueError(
            f"its walls are too ragged: {n_sides:,} sides of cells, but {MAX_SIDES:,} are allowed"
        )
    areas: Any = contour_generator(z=heights, fill_type="OuterOffset").filled(0.5, 2)
    parts = []
    for points, offsets in zip(*areas):
        rings = [_with_corners(points[a : b - 1]) for a, b in zip(offsets, offsets[1:])]
        rings = [(ring - 0.5) * (resolution, -resolution) for ring in rings]
        parts += outlines.polygons(shapely.Polygon(rings[0], rings[1:]))
    return shapely.union_all(parts)


def _with_corners(points) -> np.ndarray:
    """Returns a contour with the corners that it cuts, but for those of slanted walls."""
    points = np.round(points * 2) / 2
    following = np.roll(points, -1, 0)
    steps = following - points
    goes_on = (steps == np.roll(steps, -1, 0)).all(1)
    is_corner = (steps != 0).all(1) & ~goes_on & ~np.roll(goes_on, 1)
    is_level = points[:, 1] % 1 == 0.5  # the side that a point is in the middle of
    corners = np.where(is_level, [following[:, 0], points[:, 1]], [points[:, 0], following[:, 1]]).T
    return np.insert(points, is_corner.nonzero()[0] + 1, corners[is_corner], axis=0)


def skew(area: BaseGeometry) -> float:
    """Returns the degrees, from -45 to 45, by which most of an area's edges are turned."""
    rough = shapely.simplify(area, ROUGH)
    rings = [r for part in outlines.polygons(rough) for r in (part.exterior, *part.interiors)]
    if not rings:
        return 0.0
    edges = np.concatenate([np.diff(np.array(r.coords), axis=0) for r in rings])
    lengths = np.hypot(*edges.T)
    angles = np.degrees(np.arctan2(edges[:, 1], edges[:, 0]))
    candidates = np.arange(-45, 45, 0.05)
    off = (angles[:, None] - candidates + 45) % 90 - 45
    # long edges count more, as the short ones of a staircase have any angle
    votes = (np.exp(-((off / 0.5) ** 2)) * lengths[:, None] ** 2).sum(0)
    peak = votes.argmax()
    weights = np.where(np.abs(off[:, peak]) < 1, lengths**2, 0)
    return float(candidates[peak] + np.average(off[:, peak], weights=weights))
