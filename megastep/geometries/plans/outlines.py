"""Makes a geometry from polygons in metres: the floor that agents walk on, and the walls around it.

Whatever the drawing, the geometry is closed, as each side of the floor is a wall.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.geometries import checks

GRID = 0.01  # metres; all corners are on a grid
CURVED = 0.02  # metres by which contours of drawings and maps are simplified
MAX_EXTENT = geometry.MAX_EXTENT - 2 * geometry.MARGIN
MAX_WALLS = 8_192
MAX_CORNERS = 200_000  # of a drawing
MAX_MEETINGS = 400_000  # of the boxes around its segments
MIN_AREA = 1.0  # m2 of floor that an agent can reach
LIT = 0.1  # metres; minimum distance of a light from a wall
JAMB = 0.05  # metres; a doorway is so much wider than its door, on either side
SLIT = 0.03  # metres; narrower gaps between rooms and walls are closed
MITRE: dict = dict(join_style="mitre", cap_style="flat")


class Drawing(NamedTuple):
    """A floor plan as polygons, in metres with y up."""

    walls: list[BaseGeometry]  # solid ones, with doors and windows
    rooms: list[BaseGeometry]
    doors: list[BaseGeometry]
    outdoors: list[BaseGeometry]
    floor: BaseGeometry | None = None  # where agents walk; None: in rooms and doorways
    warnings: tuple[str, ...] = ()  # what was guessed
    closed: tuple[BaseGeometry, ...] = ()  # lines across openings that lead outside


class Notes(NamedTuple):
    """What an import reports of a geometry."""

    n_rooms: int  # in the drawing
    n_reachable: int  # of them, for an agent
    n_sealed: int  # doors to the outside that are closed
    warnings: list[str]


def polygons(shape: BaseGeometry) -> list[Polygon]:
    """Returns the polygons of a shape after repair."""
    if not shape.is_valid:
        check_meetings([shape])
    valid = shape if shape.is_valid else shapely.make_valid(shape)
    parts = shapely.get_parts(valid).tolist()
    nested = [one for part in parts for one in shapely.get_parts(part).tolist()]
    return [part for part in nested if isinstance(part, Polygon) and part.area > 1e-6]


def union(shapes: Sequence[BaseGeometry]) -> BaseGeometry:
    """Returns the union of shapes as drawn. GEOS may lose shapes that touch, unless on a grid."""
    return shapely.set_precision(shapely.union_all(shapes, grid_size=1e-9), 0)


def ring(points: np.ndarray) -> list[Polygon]:
    """Returns the polygons that a ring of points (P, 2) encloses: none for fewer than 3."""
    return polygons(Polygon(points)) if len(points) >= 3 else []


def check_meetings(shapes: Sequence[BaseGeometry], before: int = 0) -> int:
    """Returns `before` and how often boxes of segments meet. ValueError if minutes too often."""
    points, of_shape = shapely.get_coordinates(shapes, return_index=True)
    segments = np.stack([points[:-1], points[1:]], 1)[of_shape[:-1] == of_shape[1:]]
    boxes = shapely.box(*segments.min(1).T, *segments.max(1).T)
    tree, n = shapely.STRtree(boxes), before
    for start in range(0, len(boxes), 256):
        n += tree.query(boxes[start : start + 256]).shape[1]
        if n > MAX_MEETINGS:
            raise ValueError("its lines cross one another too often")
    return n


def area_of(rings: Sequence[np.ndarray], is_even_odd: bool = False) -> BaseGeometry:
    """Returns the area that rings (P, 2) enclose by one of SVG's fill rules."""
    lines = [shapely.LinearRing(points) for points in rings]
    faces = shapely.get_parts(shapely.polygonize([union(lines)]))
    points = shapely.get_coordinates(shapely.point_on_surface(faces))
    edges = np.concatenate([np.stack([r, np.roll(r, -1, 0)], 1) for r in rings])
    (x0, y0), (x1, y1) = edges[:, 0].T, edges[:, 1].T
    inside = []
    for x, y in points:
        is_left = (x1 - x0) * (y - y0) > (x - x0) * (y1 - y0)
        n_up, n_down = is_left & (y0 <= y) & (y < y1), ~is_left & (y1 <= y) & (y < y0)
        winding = int(n_up.sum()) - int(n_down.sum())
        inside.append(winding % 2 == 1 if is_even_odd else winding != 0)
    return union(faces[np.array(inside, bool)].tolist())


def filled(shape: BaseGeometry) -> BaseGeometry:
    """Returns a shape without its holes."""
    return shapely.union_all([Polygon(part.exterior) for part in polygons(shape)])


def check_extent(shapes: Sequence[BaseGeometry]) -> None:
    """Raises ValueError for a drawing that is larger than a geometry may be, or empty."""
    bounds = np.array([shape.bounds for shape in shapes if not shape.is_empty]).reshape(-1, 4)
    extent = (bounds[:, 2:].max(0) - bounds[:, :2].min(0)).max() if len(bounds) else 0
    if extent > MAX_EXTENT:
        raise ValueError(
            f"it is {extent:,.0f} m long, but the limit is {MAX_EXTENT:g} m; check the scale"
        )
    if extent < 1:
        raise ValueError(f"it is {extent:.2f} m long, but a home has at least 1 m; check the scale")


def geometry_of(
    drawing: Drawing, sealed: bool = True, tolerance: float = GRID / 2
) -> tuple[dotdict, Notes]:
    """Returns the geometry of a drawing, with contours simplified by `tolerance` metres, and notes.

    If `sealed`, doors to the outside are closed and rooms outdoors are no rooms; else they are, as
    in the original megastep. Rooms that no agent can reach keep their walls; agents do not spawn
    in them. Raises ValueError.
    """
    sealed = sealed or drawing.floor is not None  # a floor has no doors that lead outside
    shapes = [*drawing.walls, *drawing.rooms, *drawing.doors, *drawing.outdoors]
    n_corners = int(shapely.get_num_coordinates(shapes).sum())
    if n_corners > MAX_CORNERS:
        raise ValueError(f"it has {n_corners:,} corners, but the limit is {MAX_CORNERS:,}")
    check_meetings(shapes)
    rooms = drawing.rooms if sealed else [*drawing.rooms, *drawing.outdoors]
    if not rooms:
        raise ValueError("it has no room" + " indoors" * bool(drawing.outdoors))
    if not drawing.walls and drawing.floor is None:
        raise ValueError("it has no wall")
    check_extent([*drawing.walls, *rooms])
    solids = union(drawing.walls)
    openings, n_sealed = drawing.doors, 0
    if sealed and drawing.floor is None:
        openings, n_sealed = _openings(drawing, solids, rooms)
    gaps = shapely.union_all([door.buffer(JAMB, **MITRE) for door in openings])
    solids = solids.difference(gaps)
    floor = drawing.floor
    if floor is None:
        floor = shapely.union_all([*(room.buffer(SLIT, **MITRE) for room in rooms), gaps])
        floor = floor.difference(solids)  # without what is thinner than 2 cm
        floor = floor.buffer(-GRID, **MITRE).buffer(GRID, **MITRE)
    floor = shapely.simplify(shapely.set_precision(floor, GRID), tolerance)
    floor = shapely.union_all(
        [part for part in polygons(floor) if part.area > 0.02], grid_size=GRID
    )
    if floor.is_empty:
        raise ValueError("it has no floor: its walls fill it")
    edges = [floor.boundary] if sealed else []
    if drawing.walls and sealed:
        hull = filled(shapely.union_all([solids, floor]))
        edges.append(shapely.simplify(shapely.set_precision(hull, GRID), tolerance).boundary)
    elif not sealed:
        edges.append(shapely.simplify(shapely.set_precision(solids, GRID), tolerance).boundary)
    walls = merged(shapely.union_all(edges, grid_size=GRID))
    if not 3 <= len(walls) <= MAX_WALLS:
        raise ValueError(f"it has {len(walls):,} walls, but 3 to {MAX_WALLS:,} are allowed")
    inside = [polygons(room & floor if sealed else room - solids) for room in rooms]
    corners = np.concatenate([walls.reshape(-1, 2), *map(shapely.get_coordinates, inside)])
    shift = geometry.MARGIN - corners.min(0)
    walls = walls + shift
    inside = [[shapely.transform(p, lambda xy: xy + shift) for p in ps] for ps in inside if ps]
    doors = [line for door in openings if (line := _across(door, floor)) is not None]
    result = dotdict(
        id=0,
        walls=walls.astype(np.float32),
        lights=np.zeros((0, 2), np.float32),
        masks=_masks(walls, inside, corners.max(0) + shift),
        res=geometry.RES,
        doors=(np.reshape(doors, (-1, 2, 2)) + shift).astype(np.float32),
    )
    return _reachable(result, inside, n_sealed, [*drawing.warnings])


def _openings(drawing, solids, rooms) -> tuple[list[BaseGeometry], int]:
    """Returns the doors between rooms, and the number of those that lead outside."""
    hull = filled(shapely.union_all([solids, *(room.buffer(SLIT, **MITRE) for room in rooms)]))
    hull = hull.difference(shapely.union_all(drawing.outdoors).difference(solids))
    shapely.prepare(hull)
    inner = [
        door
        for door in drawing.doors
        if hull.covers(door.buffer(2 * JAMB, **MITRE).buffer(-GRID, **MITRE))
    ]
    return inner, len(drawing.doors) - len(inner)


def _masks(walls, rooms, extent) -> np.ndarray:
    """Returns the masks of rooms, each a list of polygons. A room in pieces has them all."""
    pieces = [(number, part) for number, parts in enumerate(rooms, 1) for part in parts]
    if len(pieces) > geometry.MAX_ROOMS:
        raise ValueError(f"it has {len(pieces):,} rooms, but the limit is {geometry.MAX_ROOMS:,}")
    rings = [
        [np.array(line.coords[:-1]) for line in (part.exterior, *part.interiors)]
        for _, part in pieces
    ]
    cells = geometry.masks(walls, rings, extent=extent)
    numbers = np.array([-1, 0, *(number for number, _ in pieces)], np.int16)
    return numbers[cells + 1]


def merged(lines: BaseGeometry) -> np.ndarray:
    """Returns the segments (M, 2, 2) of lines that are split where they meet. Segments that go on
    straight, where no other meets them, are one.
    """
    edges: dict[tuple, set] = {}
    for part in _lines(lines):
        points = [*map(tuple, np.rint(np.array(part.coords) / GRID).astype(int).tolist())]
        for a, b in zip(points, points[1:]):
            if a != b:
                edges.setdefault(a, set()).add(b)
                edges.setdefault(b, set()).add(a)
    for point in sorted(edges):
        if len(edges[point]) == 2:
            (ax, ay), (bx, by) = a, b = sorted(edges[point])
            x, y = point
            turn = (ax - x) * (by - y) - (ay - y) * (bx - x)
            ahead = (ax - x) * (bx - x) + (ay - y) * (by - y)
            if turn == 0 and ahead < 0 and b not in edges[a]:
                edges[a].remove(point)
                edges[b].remove(point)
                edges[a].add(b)
                edges[b].add(a)
                edges[point] = set()
    pairs = sorted((a, b) for a, others in edges.items() for b in others if a < b)
    return np.reshape(pairs, (-1, 2, 2)) * GRID


def _lines(shape) -> list:
    parts = shapely.get_parts(shape).tolist()
    return [part for part in parts if part.geom_type in ("LineString", "LinearRing")]


def _across(door, floor) -> np.ndarray | None:
    """Returns the segment (2, 2) that closes a doorway, along its wall; None if it is no floor."""
    corners = np.array(door.minimum_rotated_rectangle.exterior.coords[:4])
    sides = np.roll(corners, -1, 0) - corners
    along = sides[0] if np.hypot(*sides[0]) >= np.hypot(*sides[1]) else sides[1]
    length = np.hypot(*along)
    if length < 0.2:
        return None
    half = along / length * (length / 2 + JAMB)
    line = shapely.LineString(np.stack([corners.mean(0) - half, corners.mean(0) + half]))
    parts = [part for part in _lines(line.intersection(floor)) if part.length > 0.2]
    return np.array(max(parts, key=lambda part: part.length).coords) if parts else None


def _reachable(g, rooms, n_sealed, warnings) -> tuple[dotdict, Notes]:
    """Returns a geometry whose rooms are those that an agent can reach, with a light in each."""
    distance, fine, cell = checks.fine_rooms(g)
    labels, _ = geometry.components(distance > checks.RADIUS - 1e-3)
    can_spawn = (fine > 0) & (distance >= checks.SPAWN)
    if not can_spawn.any():
        raise ValueError("it has no room that an agent fits into; check the scale")
    main, (height, width) = np.bincount(labels[can_spawn]).argmax(), g.masks.shape
    ratio = round(g.res / cell)
    is_other = (can_spawn & (labels != main)).reshape(height, ratio, width, ratio)
    cells = np.where(is_other.any((1, 3)) & (g.masks > 0), 0, g.masks)
    fine = np.where(np.maximum(cells, 0).repeat(ratio, 0).repeat(ratio, 1) > 0, fine, 0)
    kept = np.unique(fine[can_spawn & (labels == main) & (fine > 0)])
    numbers = np.zeros(len(rooms) + 2, np.int16)
    numbers[0] = -1
    numbers[kept + 1] = np.arange(1, len(kept) + 1)
    g["masks"] = numbers[cells + 1]
    area = (fine > 0).sum() * cell**2
    if area < MIN_AREA:
        raise ValueError(f"an agent can reach {area:.1f} m2 of it, but a home has {MIN_AREA:g} m2")
    lights = [_light(rooms[room - 1], g, distance, cell) for room in kept]
    g["lights"] = np.array(lights, np.float32)
    if lost := len(rooms) - len(kept):
        warnings.append(f"{lost} of {len(rooms)} rooms cannot be reached, or hold no agent")
    return g, Notes(len(rooms), len(kept), n_sealed, warnings)


def _light(parts, g, distance, cell) -> np.ndarray:
    """Returns a room's centroid if that is clear of walls, else its largest disc's middle."""
    part = max(parts, key=lambda part: part.area)
    at = np.array(part.centroid.coords[0])
    clear = distance[tuple(geometry.indices(at, distance.shape, cell))]
    if not part.contains(part.centroid) or clear < LIT:
        at = np.array(shapely.maximum_inscribed_circle(part, 0.05).coords[0])
    return at


# ---- Plans whose rooms are not drawn ----

NECK = 0.55  # metres; half the width of the widest passage that separates two rooms
MAX_ROOMS = 1_000
WIDEST = 1.3  # metres; the widest gap in the outer walls that is closed


def rooms_of(floor: BaseGeometry) -> list[BaseGeometry]:
    """Returns the rooms of a floor: its parts between passages narrower than 1.1 m."""
    rooms, taken = [], Polygon()
    wide = polygons(floor.buffer(-NECK, **MITRE))
    if len(wide) > MAX_ROOMS:
        raise ValueError(f"it has {len(wide):,} rooms, but the limit is {MAX_ROOMS:,}")
    for part in wide:
        room = part.buffer(NECK + GRID, **MITRE).intersection(floor).difference(taken)
        rooms.append(room)
        taken = taken.union(room)
    rest = polygons(floor.difference(taken).buffer(-0.1, **MITRE).buffer(0.1, **MITRE))
    return rooms + [part for part in rest if part.area >= MIN_AREA]


def enclosed(walls: Sequence[BaseGeometry], doors: Sequence[BaseGeometry]) -> Drawing:
    """Returns the drawing of walls and doors alone: the floor is what they enclose. Gaps of up to
    1.3 m in the outer walls are closed if the floor leaks through them. Raises ValueError.
    """
    check_meetings([*walls, *doors])
    solids = union(walls)
    check_extent([solids])
    closed = shapely.union_all([solids, *(door.buffer(JAMB, **MITRE) for door in doors)])
    hull = filled(closed)
    bridged = closed.buffer(WIDEST / 2, **MITRE).buffer(-WIDEST / 2, **MITRE)
    wide = filled(bridged)
    warnings, lines = [], []
    if wide.difference(hull).area > MIN_AREA:
        hull = shapely.union_all([hull, wide])
        lines = _lines(hull.boundary.difference(closed.buffer(GRID)))
        lines = [line for line in lines if line.length > 0.2]
        widths = ", ".join(f"{line.length:.1f}" for line in lines[:8])
        warnings.append(f"{len(lines)} openings lead outside, {widths} m wide; they are closed")
    inner = [door for door in doors if hull.covers(door.buffer(2 * JAMB, **MITRE))]
    gaps = shapely.union_all([door.buffer(JAMB, **MITRE) for door in inner])
    floor = hull.difference(solids.difference(gaps))
    pieces = [part for part in polygons(floor) if part.area > 0.01]
    parts = [part for part in pieces if part.area > 0.3]
    if not parts:
        raise ValueError(
            f"its walls enclose no floor: they leave gaps wider than {WIDEST:g} m, or fill it"
        )
    floor = shapely.union_all(parts)
    rooms = rooms_of(floor.difference(gaps))
    if lost := len(pieces) - len(parts):
        warnings.append(f"{lost} pieces of floor, each under 0.3 m2, are left out")
    if outer := len(doors) - len(inner):
        warnings.append(f"{outer} doors lead outside; they are closed")
    return Drawing(
        [solids.difference(gaps)], rooms, inner, [], floor, tuple(warnings), tuple(lines)
    )
