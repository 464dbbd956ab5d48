"""Starts of hide and seek: where agents and bodies are when an episode begins.

D layouts, M starts per layout, A agents and K bodies per environment.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.modules.spawning import CLEARANCE, cached, candidates, distances, per_geometry

N_POINTS = 512  # drawn per layout
ROUNDS = 50  # of drawing a start; then the search ends
PREFIX = "hideandseek-"  # of the files in the cache, 3 MB each for 500 layouts
ANYWHERE, OUTER, INNER = range(3)  # where something may be put


def starts(
    geometries: Sequence[dotdict], n: int, radii: Sequence[float], rooms: Sequence[int], seed: int
) -> np.ndarray:
    """Returns n random starts of each geometry, (D, n, A + K, 2) float32 metres: points such that
    discs of these radii are 5 cm clear of each other and of every wall, each in its room: ANYWHERE,
    OUTER, or INNER if they fit there. ValueError if a geometry lacks that room, or has no space.
    """
    arguments = n, tuple(radii), tuple(rooms)

    def build() -> dict[str, np.ndarray]:
        draw = lambda g, random: _starts(g, *arguments, random)  # noqa: E731
        return dict(starts=np.stack(per_geometry(geometries, seed, draw)).astype(np.float32))

    return cached(PREFIX, Path(__file__), geometries, (*arguments, seed), build)["starts"]


def _starts(g, n, radii, rooms, random) -> np.ndarray:
    from scipy.spatial.distance import cdist  # which takes a while to import

    if INNER in rooms and "inner" not in g:
        raise ValueError(
            f"geometry {g.id} has no inner room, which variant=quadrant needs: use "
            "geometry=quadrant, or variant=homes"
        )
    points = next(candidates(g, N_POINTS, random))
    from_wall = distances(points, g.walls)
    room = g.masks[tuple(geometry.indices(points, g.masks.shape, g.res).T)]
    inner, fits = room == g.get("inner"), from_wall > np.reshape(radii, (-1, 1)) + CLEARANCE
    is_in = {ANYWHERE: (room > 0,), OUTER: (~inner,), INNER: (inner, room > 0)}
    places = [[part & fits[k] for part in is_in[one]] for k, one in enumerate(rooms)]
    apart = cdist(points, points) - CLEARANCE
    chosen = [_start(apart, places, np.asarray(radii), random) for _ in range(n)]
    if any(one is None for one in chosen):
        raise ValueError(
            f"geometry {g.id} has no room for {len(radii)} agents and objects of up to "
            f"{2 * max(radii):.2g} m: use fewer, or larger floor plans"
        )
    return points[np.stack(chosen)]  # pyright: ignore[reportCallIssue, reportArgumentType]


def _start(apart, places, radii, random) -> np.ndarray | None:
    """Draws the index of a point for each disc, the largest first; None if that failed too often.
    Points are ``apart`` (P, P) metres beyond the clearance. ``places`` has for each disc (P,) bool
    masks of its points: where it should be, and perhaps where it is put if it does not fit there.
    """
    order = np.argsort(radii, kind="stable")[::-1]
    for i in range(ROUNDS):
        room, start = np.full(len(apart), np.inf), np.zeros(len(radii), int)
        for k in order:
            fits = room > radii[k]
            free = [np.flatnonzero(place & fits) for place in places[k][: 1 + 2 * i // ROUNDS]]
            free = next(filter(len, free), ())
            if not len(free):
                break
            start[k] = free[random.integers(len(free))]
            room = np.minimum(room, apart[start[k]] - radii[k])
        else:
            return start
    return None
