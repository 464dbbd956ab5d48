"""Episodes of Keys: which doors are shut, where keys and goal lie, and where the agent begins.

A home's *areas* are what its doorways divide it into. A random tree of doors connects them; the
doors that are not in it stay locked. Some doors of the tree are shut, which leaves *zones*. From
the zone where the agent begins, doors are opened one after the other, and the key of each lies in a
zone that is open by then. So every episode can be solved. The goal is in the zone that opens last.

D layouts, M episodes per layout, C colours, K doorways.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.modules.spawning import CLEARANCE, cached, candidates, distances, per_geometry

RES = 0.1  # metres per cell, of the areas
N_POINTS = 512  # drawn per layout
SIDES = 0.15, 0.25, 0.35  # metres from a doorway, at which the areas beside it are looked up
OPEN = -1  # the state of a doorway without a door; else a door's colour, or C if it stays locked
APART = 0.5  # metres between the points of an episode, and between them and doorways
ROUNDS = 50  # of drawing an episode's points; then the search ends
PREFIX = "keys-"  # of the files in the cache, a megabyte each for 500 layouts


class Episodes(NamedTuple):
    """Episodes of all layouts. In a home of one area they have no doors."""

    starts: np.ndarray  # (D, M, 2) float32 metres
    keys: np.ndarray  # (D, M, C, 2) float32 metres, NaN of a colour without a door
    goals: np.ndarray  # (D, M, 2) float32 metres
    doors: np.ndarray  # (D, M, K) int32: OPEN, a colour, or C


def doors_of(g: dotdict) -> np.ndarray:
    """Returns the segments (K, 2, 2) across a home's doorways."""
    return np.reshape(g.get("doors", ()), (-1, 2, 2))


class Areas:
    """The areas of a home: ``labels`` (H, W), of each cell from 1, 0 where a wall or doorway is;
    ``sides`` (K, 2), those beside each doorway, 0 if there is none.
    """

    def __init__(self, g: dotdict):
        doors = doors_of(g)
        blocked = geometry.masks(np.concatenate([g.walls, doors]), [], RES)[::-1] < 0
        self.labels, _ = geometry.components(~blocked)
        along = doors[:, 1] - doors[:, 0]
        normal = along[:, ::-1] * (-1, 1) / np.linalg.norm(along, axis=-1, keepdims=True)
        middle = doors.mean(1)
        self.sides = np.zeros((len(doors), 2), int)
        for metres in SIDES[::-1]:  # the nearest wins
            for side, sign in enumerate((-1, 1)):
                found = self.at(middle + sign * metres * normal)
                self.sides[:, side] = np.where(found, found, self.sides[:, side])

    def at(self, points: np.ndarray) -> np.ndarray:
        """Returns the areas (P,) at points (P, 2) metres."""
        column, row = np.floor(points / RES).astype(int).T
        return self.labels[row, column]


def episodes(geometries: Sequence[dotdict], n: int, n_colours: int, seed: int) -> Episodes:
    """Returns n episodes of each geometry. ValueError: no doorway between areas, or no room."""
    n_doors = max(len(doors_of(g)) for g in geometries)

    def build() -> dict[str, np.ndarray]:
        draw = lambda g, random: _episodes(g, n, n_colours, n_doors, random)  # noqa: E731
        *points, doors = map(np.stack, zip(*per_geometry(geometries, seed, draw)))
        starts, keys, goals = (part.astype(np.float32) for part in points)
        if np.isnan(keys).all():
            raise ValueError(
                f"geometry {geometries[0].id} has no doorway between two of its parts, nor has any "
                "other: Keys needs homes with doors, such as geometry=homes"
            )
        return Episodes(starts, keys, goals, doors)._asdict()

    return Episodes(**cached(PREFIX, Path(__file__), geometries, (n, n_colours, seed), build))


def _episodes(g, n, n_colours, n_doors, random) -> tuple[np.ndarray, ...]:
    areas, doors = Areas(g), doors_of(g)
    points = next(candidates(g, N_POINTS, random))
    is_clear = distances(points, g.walls) > 0.15 + CLEARANCE
    points = points[is_clear & (distances(points, doors) > APART)]
    of_point = areas.at(points)
    points, of_point = points[of_point > 0], of_point[of_point > 0]
    known = {*of_point.tolist()}
    usable = [k for k, (a, b) in enumerate(areas.sides.tolist()) if a != b and {a, b} <= known]
    starts, keys, goals = np.empty((n, 2)), np.full((n, n_colours, 2), np.nan), np.empty((n, 2))
    states = np.full((n, n_doors), OPEN, np.int32)
    for m in range(n):
        for _ in range(ROUNDS):
            zones, opened = np.arange(areas.labels.max() + 1), []
            if usable:
                zones, opened, states[m, : len(doors)] = _doors(areas, usable, n_colours, random)
            at = _points(points, zones[of_point], opened, random)
            if at is not None:
                break
        else:
            raise ValueError(f"geometry {g.id} has no room for keys and a goal, {APART:g} m apart")
        starts[m], goals[m] = at[:2]
        for (colour, *_), place in zip(opened, at[2:]):
            keys[m, colour] = place
    return starts, keys, goals, states


def _doors(areas, usable, n_colours, random) -> tuple[np.ndarray, list, np.ndarray]:
    """Draws which doors are shut. Returns zones of areas, doors in order, states of doorways."""
    n_areas = int(areas.labels.max()) + 1
    part, tree, states = [*range(n_areas)], [], np.full(len(areas.sides), OPEN, np.int32)
    for k in random.permutation(usable).tolist():
        a, b = (part[area] for area in areas.sides[k])
        if a == b:
            states[k] = n_colours  # locked: the tree leads there by another way
        else:
            part = [a if p == b else p for p in part]
            tree.append(k)
    home = part[areas.sides[tree[0], 0]]  # of several unconnected ones
    tree = [k for k in tree if part[areas.sides[k, 0]] == home]
    shut = tree[:n_colours]
    zones = [area if part[area] == home else -1 for area in range(n_areas)]
    for k in tree[n_colours:]:
        a, b = (zones[area] for area in areas.sides[k])
        zones = [a if zone == b else zone for zone in zones]
    start = zones[areas.sides[shut[int(random.integers(len(shut)))], int(random.integers(2))]]
    reached, opened = [start], []
    colours = random.permutation(n_colours).tolist()
    while len(opened) < len(shut):
        ready = []
        for k in shut:
            a, b = (zones[area] for area in areas.sides[k])
            if (a in reached) != (b in reached):
                ready.append((k, b if a in reached else a))
        k, behind = ready[int(random.integers(len(ready)))]
        states[k] = colours[len(opened)]
        lies = reached[int(random.integers(len(reached)))]
        opened.append((states[k], lies, behind))
        reached.append(behind)
    _lock_ways_around(areas, usable, zones, n_colours, states)
    return np.array(zones), opened, states


def _lock_ways_around(areas, usable, zones, locked, states) -> None:
    """Locks doorways, open ones of areas too small for a point, that lead from zone to zone."""
    joined = [~area if zone < 0 else zone for area, zone in enumerate(zones)]
    for k, (a, b) in enumerate(areas.sides.tolist()):
        if k in usable or not a or not b:
            continue
        inner, outer = sorted((joined[a], joined[b]))
        if 0 <= inner < outer:
            states[k] = locked
        else:
            joined = [outer if one == inner else one for one in joined]


def _points(points, zones, opened, random) -> list | None:
    """Draws points (2,) in their zones (P,); None if there is no room."""
    first = opened[0][1] if opened else zones[random.integers(len(zones))] if len(zones) else 0
    last, chosen = opened[-1][2] if opened else first, []
    for zone in (first, last, *(lies for _, lies, _ in opened)):
        fits = zones == zone
        for other in chosen:
            fits &= np.linalg.norm(points - other, axis=-1) > APART
        if not fits.any():
            return None
        chosen.append(points[random.choice(np.flatnonzero(fits))])
    return chosen
