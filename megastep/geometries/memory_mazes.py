"""Mazes of rooms and corridors, as those of Memory Maze (Pasukonis et al. 2022).

A maze is a square of `size` x `size` cells, each floor or wall. Rooms and corridors have odd
coordinates and odd lengths, so that a wall of one cell fits between any two. As in DeepMind Lab's
mazes: rooms are put at random places, what is left is filled with corridors, all are joined by
openings, and dead ends are filled in. A seed gives the same bytes on every machine.

Cell (row, column) is floor if `floor[row, column]`; row 0 is at the bottom.
"""

from typing import NamedTuple

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.geometries.homes.portable_generator import PortableGenerator
from megastep.geometries.homes.walls import INDOORS, WALL, segments
from megastep.geometries.mazes import START, lit_cells

COUNT = 5_000  # mazes per size, of seeds 0 to 4,999
MIN_CELL = 0.5  # metres
LIT = 3  # cells; a light is at most this walk from any floor
ATTEMPTS = 200  # to put a room somewhere
LOOPS = 0.2  # chance that an opening is made that no room needs
STEPS = (0, 1), (0, -1), (1, 0), (-1, 0)


class Kind(NamedTuple):
    """What a size of mazes has."""

    objects: int  # of an episode of Memory Maze; each in a room of its own
    rooms: int  # at most
    widest: int  # cells of the side of a room; the shortest is 3


#: The kinds by size.
KINDS = {
    9: Kind(objects=3, rooms=4, widest=5),
    11: Kind(objects=4, rooms=6, widest=5),
    13: Kind(objects=5, rooms=6, widest=5),
    15: Kind(objects=6, rooms=9, widest=3),
}


def _rooms(size, generator) -> list[tuple[int, int, int, int]]:
    """Returns (first row, first column, rows, columns) of rooms that do not touch."""
    kind, rooms = KINDS[size], []
    taken = np.zeros((size, size), bool)
    for _ in range(ATTEMPTS):
        height, width = (3 + 2 * generator.below((kind.widest - 1) // 2) for _ in range(2))
        i, j = (2 * generator.below((size - n) // 2 + 1) for n in (height, width))
        if len(rooms) < kind.rooms and not taken[i : i + height, j : j + width].any():
            taken[i : i + height, j : j + width] = True
            rooms.append((i, j, height, width))
    return rooms


def _within(size, i, j) -> bool:
    return 0 <= i < size and 0 <= j < size


def _dig(size, rooms, generator) -> np.ndarray:
    """Returns the region of each cell, 0 for walls: rooms from 1, then trees of corridors."""
    regions = np.zeros((size, size), int)
    for number, (i, j, height, width) in enumerate(rooms, 1):
        regions[i : i + height, j : j + width] = number
    n_regions = len(rooms)
    for start in range(((size + 1) // 2) ** 2):
        i, j = (2 * k for k in divmod(start, (size + 1) // 2))
        if regions[i, j]:
            continue
        n_regions += 1
        regions[i, j] = n_regions
        way = [(i, j)]  # a random walk that turns back where it is stuck
        while way:
            i, j = way[-1]
            exits = [
                (y, x)
                for y, x in STEPS
                if _within(size, i + 2 * y, j + 2 * x) and not regions[i + 2 * y, j + 2 * x]
            ]
            if not exits:
                way.pop()
                continue
            y, x = exits[generator.below(len(exits))]
            regions[i + y, j + x] = regions[i + 2 * y, j + 2 * x] = n_regions
            way.append((i + 2 * y, j + 2 * x))
    return regions


def _join(regions, generator) -> None:
    """Opens walls between regions until all are connected, and some more."""
    walls, doors = np.pad(regions, 1), []
    for i, j in np.argwhere(regions == 0).tolist():
        for y, x in STEPS[0::2]:
            a, b = walls[i + 1 + y, j + 1 + x], walls[i + 1 - y, j + 1 - x]
            if 0 != a != b != 0:
                doors.append((i, j, a, b))
    part = list(range(regions.max() + 1))
    for i, j, a, b in generator.shuffled(doors):
        if part[a] != part[b]:
            part = [part[a] if p == part[b] else p for p in part]
        elif not generator.chance(LOOPS):
            continue
        regions[i, j] = regions.max() + 1


def _around(floor, i, j) -> list[tuple[int, int]]:
    beside = [(i + y, j + x) for y, x in STEPS]
    return [at for at in beside if _within(len(floor), *at) and floor[at]]


def floor_plan(seed: int, size: int) -> tuple[np.ndarray, list[tuple[int, int, int, int]]]:
    """Returns the floor (size, size) bool of the maze of a seed, and its `_rooms`."""
    generator = PortableGenerator(seed * len(KINDS) + sorted(KINDS).index(size))
    rooms = []
    while len(rooms) < KINDS[size].objects:
        rooms = _rooms(size, generator)
    regions = _dig(size, rooms, generator)
    _join(regions, generator)
    floor, ends = regions > 0, [(0, 0)]
    while ends:
        ends = [(i, j) for i, j in np.argwhere(floor).tolist() if len(_around(floor, i, j)) < 2]
        for at in ends:
            floor[at] = False
    return floor, rooms


def generate(seed: int, size: int = 9, cell: float = 0.6) -> dotdict:
    """Returns the maze of a seed: a geometry whose rooms are the maze's, without corridors. So
    agents spawn in rooms. A cell is rounded to a millimetre. `floor` (size, size) bool tells cells
    of `cell` metres apart, the first at (`corner`, `corner`). Raises ValueError for a size that is
    none of `KINDS`.
    """
    if size not in KINDS:
        raise ValueError(
            f"size={size!r}: Memory Maze has mazes of {', '.join(map(str, KINDS))} cells"
        )
    side = round(1000 * cell)
    floor, rooms = floor_plan(seed, size)
    lines = START + side * np.arange(size + 3)
    grid = np.full((size + 2, size + 2), WALL, np.int8)
    grid[1:-1, 1:-1][floor] = INDOORS
    walls = segments(lines, lines, grid, INDOORS) / 1000

    cells = [tuple(at) for at in np.argwhere(floor).tolist()]
    numbers_of = {at: k for k, at in enumerate(cells)}
    beside = [[numbers_of[other] for other in _around(floor, *at)] for at in cells]
    lit = np.array([cells[k] for k in lit_cells(beside, LIT)])[:, ::-1]
    polygons = [
        lines[1] / 1000
        + side / 1000 * np.array([(j, i), (j + width, i), (j + width, i + height), (j, i + height)])
        for i, j, height, width in rooms
    ]
    return dotdict(
        id=seed,
        walls=walls.astype(np.float32),
        lights=((lines[1] + side * (lit + 0.5)) / 1000).astype(np.float32),
        masks=geometry.masks(walls, polygons),
        res=geometry.RES,
        floor=floor,
        cell=side / 1000,
        corner=lines[1] / 1000,
    )
