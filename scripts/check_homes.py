"""Checks of a generated home: those of every geometry, and what makes it like a real home.
`make_homes.py` uses them.
"""

import numpy as np

from megastep import geometry
from megastep.geometries import checks

FINEST = 0.02  # metres; in cluttered homes a body 21 cm wide has so much to spare in 24 cm
LIT = 0.05  # metres; minimum distance of a light from a wall
GAP = 0.55  # metres; minimum width of a passage
MAX_WALLS, MAX_EXTENT = 500, 40.0
MIN_CELLS = 4  # minimum cells of a room in the masks


def errors(g, is_cluttered=False):
    """Returns a sentence for each error in a home. In a cluttered one gaps may be as narrow as an
    agent.
    """
    messages = checks.errors(g, FINEST if is_cluttered else checks.FINE)
    if np.abs(g.walls.min((0, 1)) - 1).max() > 1e-3 and g.n_outer:
        messages.append(f"coordinates start at {g.walls.min((0, 1))} and not at 1 m")
    if np.ptp(g.walls, axis=(0, 1)).max() > MAX_EXTENT or len(g.walls) > MAX_WALLS:
        messages.append("it is too large")
    rooms = g.masks.max()
    if min(np.bincount(g.masks[g.masks > 0], minlength=rooms + 1)[1:], default=0) < MIN_CELLS:
        messages.append("a room has too few cells")
    distance, ratio = checks.clearance(g), round(g.res / checks.FINE)
    if (distance[tuple(geometry.indices(g.lights, distance.shape, checks.FINE).T)] < LIT).any():
        messages.append("a light is in a wall")
    if not is_cluttered:
        fine = np.maximum(g.masks, 0).repeat(ratio, 0).repeat(ratio, 1)
        labels, _ = geometry.components(distance > GAP / 2 - 1e-3)
        if not checks.joins(labels, fine):
            messages.append("a disc as wide as the narrowest gap cannot reach every room")
    light_cells = tuple(geometry.indices(g.lights, g.masks.shape, g.res).T)
    if not np.array_equal(g.masks[light_cells], np.arange(1, rooms + 1)):
        messages.append("a light is not in its room")
    return messages
