"""Homes: floor plans like those of real flats and houses.

`generate(seed)` makes the home of a seed, the same on every machine (see `random_stream`): a number
of rooms, what they are, an outline, a partition, doors and openings, walls. `database` holds 5,000
ready ones, those of seeds 0 to 4,999.
"""

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.geometries.homes import openings, partition, plan, walls
from megastep.geometries.homes.portable_generator import PortableGenerator

ATTEMPTS = 60  # plans tried before a home is given one room less
# The best of three plans is taken; with more than ten rooms, which are expensive, the first.
ENOUGH, FEW = 3, 10
THIN, THICK = (10, 11, 12, 14), (20, 24, 30)  # cm; the thickness of inner walls and of the envelope
SLANTED = 0.08  # of the homes have a corner cut off at 45 degrees
START = 100  # cm; the minimum coordinate of a home


def _attempt(count, stream):
    """A plan of `count` rooms as [(cost, footprint, rooms, contacts, depth, gaps)], or [] if it
    does not work out.
    """
    rooms = plan.programme(count, stream)
    footprint = plan.footprint(sum(size for _, size in rooms), stream)
    try:
        rooms, sides = partition.partition(footprint, rooms, stream)
    except partition.Failure:
        return []
    depth = walls.depths(sides, THIN[stream.below(len(THIN))])
    meetings = openings.contacts(rooms)
    spans = {contact: openings.clear(contact, meetings, depth) for contact in meetings}
    found = openings.connections(rooms, spans, stream)
    if not found:
        return []
    cost, chosen = found
    gaps = [
        openings.opening(c, spans[c], (rooms[c.a].kind, rooms[c.b].kind), stream) for c in chosen
    ]
    return [(cost, footprint, rooms, meetings, depth, gaps)]


def _best_plan(stream):
    """The best of a few plans: (cost, footprint, rooms, contacts, depth, gaps).

    The number of rooms is drawn once, before any plan is rejected: small homes work out more
    often, so drawing it anew each time would make the homes small.
    """
    count = plan.room_count(stream)
    while True:
        found = []
        for _ in range(ATTEMPTS):
            found += _attempt(count, stream)
            if len(found) >= (ENOUGH if count <= FEW else 1):
                break
        if found:
            return min(found, key=lambda found: found[0])
        count -= 1


def generate(seed: int, outer: bool = True) -> dotdict:
    """The home of a seed, any integer; if not `outer`, less its envelope's outer face, which cannot
    be seen from indoors.

    A geometry with further keys: `rooms`, the kind of each room in the order of the masks' numbers;
    `areas`, their clear areas in m2; `doors` and `openings`, the widths in metres of the gaps with
    and without a door; `n_outer`, how many of the walls, the last ones, are the envelope's outer
    face.
    """
    stream = PortableGenerator(seed)
    _, footprint, rooms, meetings, depth, gaps = _best_plan(stream)
    thickness = THICK[stream.below(len(THICK))]
    grid = walls.paint(
        footprint, walls.solids(meetings, depth), [walls.gap(g, depth) for g in gaps], thickness
    )
    inside, outside = walls.segments(*grid, walls.INDOORS), walls.segments(*grid, walls.OUTDOORS)
    lights = [walls.light(room.region, inside) for room in rooms]
    rings = [
        [[(x0, y0), (x1, y0), (x1, y1), (x0, y1)] for x0, y0, x1, y1 in room.region]
        for room in rooms
    ]
    if stream.chance(SLANTED):
        inside, outside, triangle = walls.slanted(inside, outside, *grid, thickness, stream)
        for room, ring in zip(rooms, rings):
            ring += [triangle] if walls.holds(room.region, triangle) else []

    shift = START - outside.min((0, 1))
    lines = (np.concatenate([inside, outside]) + shift) / 100
    masks = geometry.masks(
        lines, [[(np.array(ring) + shift) / 100 for ring in room] for room in rings]
    )
    doors = [[(g.high - g.low) / 100 for g in gaps if g.door is kind] for kind in (True, False)]
    return dotdict(
        id=seed,
        walls=lines[: len(lines) if outer else len(inside)].astype(np.float32),
        lights=((np.array(lights) + shift) / 100).astype(np.float32),
        masks=masks,
        res=geometry.RES,
        rooms=[room.kind for room in rooms],
        areas=walls.areas(grid, [room.region for room in rooms]),
        doors=doors[0],
        openings=doors[1],
        n_outer=len(outside) if outer else 0,
    )
