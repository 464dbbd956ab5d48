"""Homes: floor plans like those of real flats and houses.

`generate(seed)` generates a home in steps: the number and kinds of rooms, the outline, a partition
into rooms, doors and openings, walls. A seed gives the same home on every machine
(`portable_generator`). The homes of seeds 0 to 4,999 come with the package.
"""

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.geometries.homes import furniture, plan, walls
from megastep.geometries.homes.portable_generator import PortableGenerator

ATTEMPTS = 60  # plans tried before a home gets one room less
# The best of three plans is taken. With more than ten rooms plans are expensive: take the first.
ENOUGH, FEW = 3, 10
THIN, THICK = (10, 11, 12, 14), (20, 24, 30)  # cm; thickness of inner walls and of the envelope
SLANTED = 0.08  # fraction of homes with a corner cut off at 45 degrees
START = 100  # cm; the minimum coordinate of a home


def _attempt(count, generator, style) -> list[tuple]:
    """Plans `count` rooms: [(cost, footprint, rooms, contacts, depth, gaps)], [] on failure."""
    programme = plan.programme(count, generator)
    footprint = plan.footprint(sum(size for _, size in programme), generator)
    result = plan.partition(footprint, programme, generator, style)
    if not result:
        return []
    rooms, sides = result
    depth = walls.depths(sides, THIN[generator.below(len(THIN))])
    meetings = walls.contacts(rooms)
    spans = {contact: walls.clear(contact, meetings, depth) for contact in meetings}
    result = walls.connections(rooms, spans, generator)
    if not result:
        return []
    cost, connections = result
    gaps = [
        walls.draw_opening(c, spans[c], (rooms[c.a].kind, rooms[c.b].kind), generator, style)
        for c in connections
    ]
    return [(cost, footprint, rooms, meetings, depth, gaps)]


def _best_plan(generator, style) -> tuple:
    """Returns the best of a few plans of one number of rooms, as drawing that again after a failure
    would make homes too small: (cost, footprint, rooms, contacts, depth, gaps).
    """
    count, plans = plan.room_count(generator, style), []
    while not plans:
        for _ in range(ATTEMPTS):
            plans += _attempt(count, generator, style)
            if len(plans) >= (ENOUGH if count <= FEW else 1):
                break
        count -= 1
    return min(plans, key=lambda plan: plan[0])


def _doorways(gaps, depth, half_blocked, generator) -> tuple[list, list]:
    """Returns rectangles that stay clear before doorways, and blocked parts of some gaps."""
    clear, blocked = [], []
    for g in gaps:
        low, high, reach = g.low, g.high, furniture.PASSAGE
        if half_blocked and generator.chance(half_blocked):
            reach = furniture.tight(generator)
            low, high = (low, low + reach) if generator.below(2) else (high - reach, high)
            rest = (high, g.high) if low == g.low else (g.low, low)
            blocked.append(walls.gap(g._replace(low=rest[0], high=rest[1]), depth))
        doorway, axis = [*walls.gap(g._replace(low=low, high=high), depth)], g.contact.axis
        doorway[axis] -= reach
        doorway[axis + 2] += reach
        clear.append(tuple(doorway))
    return clear, blocked


def _metres(points, shift) -> np.ndarray:
    return (np.array(points) + shift) / 100


def generate(seed: int, density: float = 1, clutter: float = 0) -> dotdict:
    """Returns the home of a seed.

    Args:
        seed: any integer.
        density: from 1 to 3, at which a home has about three times as many walls: more rooms,
            narrower doors, fewer openings without one, furniture, lights off the middle of rooms.
        clutter: from 0 to 1, at which much of the furniture leaves gaps of 24 to 46 cm to walls, to
            other furniture, and in doorways.

    Returns:
        A geometry with further keys: `rooms`, the kind of each room in the order of the masks'
        numbers; `areas`, their clear areas in m2; `openings`, as `doors` where is none; `n_outer`,
        the number of walls, the last ones, that are the envelope's outer face.
    """
    generator, style = PortableGenerator(seed), plan.style(density, clutter)
    _, footprint, rooms, meetings, depth, gaps = _best_plan(generator, style)
    thickness = THICK[generator.below(len(THICK))]
    solids = walls.solids(meetings, depth)
    layers = footprint, solids, [walls.gap(g, depth) for g in gaps], thickness
    grid = walls.paint(*layers)
    inside, outside = walls.segments(*grid, walls.INDOORS), walls.segments(*grid, walls.OUTDOORS)
    lights = [walls.light(room.region, inside) for room in rooms]
    rings = [
        [[(x0, y0), (x1, y0), (x1, y1), (x0, y1)] for x0, y0, x1, y1 in room.region]
        for room in rooms
    ]
    triangle = []
    if generator.chance(SLANTED):
        inside, outside, triangle = walls.slanted(inside, outside, grid, thickness, generator)
    is_cut = [walls.holds(room.region, triangle) for room in rooms]
    for ring in (ring for ring, cut in zip(rings, is_cut) if cut):
        ring.append(triangle)
    if style.furniture:
        for i, room in enumerate(rooms):
            if not is_cut[i] and generator.chance(style.off_centre):
                lights[i] = furniture.place_light(room.region, solids, generator)
        clear, blocked = _doorways(gaps, depth, style.half_blocked, generator)
        reach = furniture.BESIDE_LIGHT
        clear += [(x - reach, y - reach, x + reach, y + reach) for x, y in lights]
        pieces = []
        for room in (room for room, cut in zip(rooms, is_cut) if not cut):
            pieces += furniture.furnish(room.region, solids, clear, blocked, style, generator)
        grid = walls.paint(*layers, pieces)
        inside = walls.segments(*grid, walls.INDOORS)
        inside = walls.cut_off(inside, triangle) if triangle else inside

    shift = START - outside.min((0, 1))
    lines = _metres(np.concatenate([inside, outside]), shift)
    masks = geometry.masks(lines, [[_metres(ring, shift) for ring in room] for room in rings])
    if style.furniture:  # no line marks the cells that are wholly inside it
        y, x = ((np.arange(n) + 0.5) * geometry.RES * 100 for n in masks.shape)
        masks[(masks > 0) & ~walls.are_indoors(grid, x - shift[0], y[::-1] - shift[1])] = 0
    doors, open_ = (
        _metres(
            np.reshape([walls.across(g) for g in gaps if g.door is has_door], (-1, 2, 2)), shift
        )
        for has_door in (True, False)
    )
    return dotdict(
        id=seed,
        walls=lines.astype(np.float32),
        lights=_metres(lights, shift).astype(np.float32),
        masks=masks,
        res=geometry.RES,
        rooms=[room.kind for room in rooms],
        areas=walls.areas(grid, [room.region for room in rooms]),
        doors=doors.astype(np.float32),
        openings=open_.astype(np.float32),
        n_outer=len(outside),
    )
