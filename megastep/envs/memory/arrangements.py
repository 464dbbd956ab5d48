"""Where an episode's objects may lie. D layouts, M arrangements per layout, O objects."""

from collections.abc import Sequence

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.modules.spawning import CLEARANCE, candidates, distances

N_POINTS = 512  # drawn per layout
ROUNDS = 20  # of drawing arrangements; then the search ends


def arrangements(
    geometries: Sequence[dotdict], n: int, n_objects: int, radius: float, apart: float, seed: int
) -> np.ndarray:
    """Returns random points for objects, (D, n, n_objects, 2) float32 metres, each in a room of its
    own if there are as many. If fewer arrangements are found, some are repeated.

    Args:
        geometries: floor plans. The same object may occur several times.
        n: arrangements per layout.
        n_objects: points of each.
        radius: metres; discs of it around the points are 5 cm clear of walls.
        apart: metres between two points, at least.
        seed: of the points.

    Raises:
        ValueError: naming a geometry where the objects do not fit.
    """
    distinct = {id(g): g for g in geometries}
    found = {
        key: _arrangements(g, n, n_objects, radius, apart, np.random.Generator(bits))
        for (key, g), bits in zip(
            distinct.items(), (np.random.Philox([seed, d]) for d in range(len(distinct)))
        )
    }
    return np.stack([found[id(g)] for g in geometries]).astype(np.float32)


def _arrangements(g, n, n_objects, radius, apart, random) -> np.ndarray:
    points = next(candidates(g, N_POINTS, random))
    points = points[distances(points, g.walls) > radius + CLEARANCE]
    numbers = g.masks[tuple(geometry.indices(points, g.masks.shape, g.res).T)]
    order = numbers.argsort(kind="stable")
    _, starts, counts = np.unique(numbers[order], return_index=True, return_counts=True)
    kept = np.empty((0, n_objects, 2))
    for _ in range(ROUNDS if len(points) else 0):
        rooms = random.random((n, len(counts))).argsort(1)
        rooms = rooms[:, np.arange(n_objects) % len(counts)]
        index = starts[rooms] + (random.random(rooms.shape) * counts[rooms]).astype(int)
        drawn = points[order[index]]
        away = np.linalg.norm(drawn[:, :, None] - drawn[:, None], axis=-1)
        away[:, np.arange(n_objects), np.arange(n_objects)] = np.inf
        kept = np.concatenate([kept, drawn[away.min((1, 2)) >= apart]])[:n]
        if len(kept) == n:
            return kept
    if not len(kept):
        raise ValueError(
            f"geometry {g.id} has no room for {n_objects} objects, {apart:.2f} m apart: take fewer "
            "objects or larger homes"
        )
    return np.resize(kept, (n, n_objects, 2))
