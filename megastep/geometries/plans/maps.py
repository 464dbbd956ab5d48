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

from megastep import geometry
from megastep.geometries.plans import outlines
from megastep.geometries.plans.outlines import Drawing

MAX_PIXELS = 25_000_000
MAX_YAML = 1 << 16  # bytes
FORMATS = ("PNG", "PPM", "BMP", "JPEG", "TIFF")
TOLERANCE = 0.02  # metres by which contours are simplified, and at least STEP of a pixel
STEP = 0.6
SPECKLE = 0.03  # m2; smaller objects on the floor, and smaller holes in walls, are no walls
MAX_ANGLE = 5.0  # degrees by which a map is straightened
MIN_ANGLE = 0.15
ROUGH = 0.05  # metres by which contours are simplified to find their angle


class Map(NamedTuple):
    """A map: (H, W) cells with row 0 at the top, free, unknown or neither, which is a wall."""

    free: np.ndarray
    unknown: np.ndarray
    resolution: float  # metres per cell


def load(path: Path, metres_per_pixel: float | None = None) -> Map:
    """Returns the map of a ROS `.yaml`, or of an image if `metres_per_pixel` is given.

    Raises:
        ValueError: saying what is wrong with the file.
    """
    if path.suffix.lower() not in (".yaml", ".yml"):
        if metres_per_pixel is None:
            raise ValueError("an image needs metres_per_pixel=, such as 0.02")
        free = _image(path) >= 128
        return Map(free, np.zeros_like(free), metres_per_pixel)
    if path.stat().st_size > MAX_YAML:
        raise ValueError(f"it has more than {MAX_YAML:,} bytes")
    try:
        given = yaml.safe_load(path.read_bytes())
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ValueError("it is no YAML") from error
    if not isinstance(given, dict) or not isinstance(given.get("image"), str):
        raise ValueError("it has no 'image'; a map of ROS has image, resolution and origin")
    numbers = {"occupied_thresh": 0.65, "free_thresh": 0.196, "negate": 0}
    for key in ("resolution", *numbers):
        value = given.get(key, numbers.get(key))
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"its {key} is {value!r}, no number")
        numbers[key] = value
    image = (path.parent / given["image"]).resolve()
    if not image.is_relative_to(path.parent.resolve()):
        raise ValueError("its image is not in its own folder")
    values = _image(image).astype(float) / 255
    occupied = values if numbers["negate"] else 1 - values
    free = occupied < numbers["free_thresh"]
    unknown = ~free & (occupied <= numbers["occupied_thresh"])
    return Map(free, unknown, float(metres_per_pixel or numbers["resolution"]))


def _image(path) -> np.ndarray:
    """Returns an image as (H, W) grey levels."""
    if not path.is_file():
        raise ValueError(f"there is no image {path.name!r}")
    try:
        with Image.open(io.BytesIO(path.read_bytes()), formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(
                    f"its image has {image.width * image.height:,} pixels, but the limit is "
                    f"{MAX_PIXELS:,}"
                )
            flat = Image.new("RGBA", image.size, "white")
            flat.alpha_composite(image.convert("RGBA"))  # what is transparent is floor
            return np.asarray(flat.convert("L"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"its image {path.name!r} cannot be read, or is cut short") from error


def read(grid: Map) -> tuple[Drawing, list[str]]:
    """Returns the drawing of a map, straightened and without speckles, and warnings.

    Raises:
        ValueError: saying what is wrong with the map.
    """
    resolution = grid.resolution
    if not np.isfinite(resolution) or resolution <= 0:
        raise ValueError(f"its resolution is {resolution:g} m, but must be above 0")
    if not grid.free.any():
        raise ValueError("the map is all walls: no cell is free")
    extent = max(grid.free.shape) * resolution
    if extent > 10 * outlines.MAX_EXTENT:
        raise ValueError(f"the map is {extent:,.0f} m long; check the resolution")
    n_cells = max(2, round(SPECKLE / resolution**2))
    around = [
        ndimage.convolve(c.astype(int), np.ones((3, 3)), mode="constant")
        for c in (grid.free, ~grid.free)
    ]
    free = ~_without_specks(around[0] <= around[1], n_cells)
    free = _without_specks(free, n_cells)
    warnings = []
    on_border = np.concatenate([free[0], free[-1], free[:, 0], free[:, -1]])
    is_drawing = bool(on_border.any()) and not grid.unknown.any()
    floor = _area(~free if is_drawing else free, resolution)
    angle = skew(floor)
    if MIN_ANGLE < abs(angle) <= MAX_ANGLE:
        floor = affinity.rotate(floor, -angle, origin=(0, 0))
        warnings.append(f"the map is turned by {-angle:.1f} degrees, so that its walls are level")
    floor = shapely.simplify(floor, max(TOLERANCE, STEP * resolution))
    if is_drawing:
        return outlines.enclosed(outlines.polygons(floor), []), warnings
    edge = ndimage.binary_dilation(free, np.ones((3, 3))) & grid.unknown
    if (length := edge.sum() * resolution) > 0.5:
        warnings.append(f"about {length:.1f} m of the floor's edge is unknown, and is a wall now")
    parts = [part for part in outlines.polygons(floor) if part.area >= outlines.MIN_AREA]
    if not parts:
        raise ValueError(f"no floor of {outlines.MIN_AREA:g} m2 is free; check the resolution")
    outlines.check_extent(parts)
    floor = shapely.union_all(parts)
    return Drawing([], outlines.rooms_of(floor), [], [], floor), warnings


def _without_specks(cells, n_cells) -> np.ndarray:
    """Returns cells (H, W) without the connected ones that are at most `n_cells`."""
    labels, _ = geometry.components(cells)
    is_large = np.bincount(labels.ravel()) > n_cells
    is_large[0] = False
    return is_large[labels]


def _area(cells, resolution) -> shapely.geometry.base.BaseGeometry:
    """Returns the area of cells (H, W) in metres, its contours smoothed by a cell."""
    smooth = ndimage.gaussian_filter(np.pad(cells, 2).astype(float), 0.7, mode="nearest")
    area = shapely.Polygon()
    rings: Any = contour_generator(z=smooth).lines(0.5)
    parts = [part for ring in rings for part in outlines.ring(ring * (1, -1))]
    for part in sorted(parts, key=lambda part: -part.area):  # a hole after what it is in
        inside = area.contains(part.representative_point())
        area = area.difference(part) if inside else area.union(part)
    return shapely.transform(area, lambda points: points * resolution)


def skew(area: shapely.geometry.base.BaseGeometry) -> float:
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
