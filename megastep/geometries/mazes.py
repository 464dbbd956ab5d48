"""Mazes: square grids of cells, joined by openings as wide as the corridors.

A perfect maze has exactly one path between any two cells: it is a spanning tree of the grid. Trees
are drawn by Wilson's algorithm ("Generating random spanning trees more quickly than the cover
time", STOC 1996), so all perfect mazes of a size are equally likely. A braided maze has some dead
ends opened, which makes loops. A seed gives the same bytes on every machine
(:mod:`~megastep.geometries.homes.portable_generator`).

Lengths in this file are in millimetres. A cell is the number row * size + column, with row 0 at the
bottom.
"""

import itertools

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.geometries.homes.portable_generator import PortableGenerator
from megastep.geometries.homes.walls import INDOORS, WALL, segments

COUNT = 5_000  # mazes per kind, of seeds 0 to 4,999; as many as homes
# Metres. An agent's disc with 5 cm on either side is 0.312 m wide; it needs a strip to spawn in.
MIN_CORRIDOR = 0.32
START = 1_000  # mm; about where the lower-left corner is
LIT = 3_000  # mm; a light is at most this walk, or two cells, from any cell


def passages(size: int, braid: float, generator: PortableGenerator) -> list[list[int]]:
    """Returns the cells that each cell opens to, a fraction `braid` of dead ends opened."""
    neighbours = [
        [
            row * size + column
            for row, column in ((i, j - 1), (i, j + 1), (i - 1, j), (i + 1, j))
            if 0 <= row < size and 0 <= column < size
        ]
        for i, j in itertools.product(range(size), repeat=2)
    ]
    opened = [[] for _ in neighbours]

    def join(a, b) -> None:
        opened[a].append(b)
        opened[b].append(a)

    in_tree = [False] * len(neighbours)
    in_tree[generator.below(len(neighbours))] = True
    for start in range(len(neighbours)):
        # A random walk to the tree. The last exit from each cell gives the walk without loops.
        exits, cell = {}, start
        while not in_tree[cell]:
            exits[cell] = neighbours[cell][generator.below(len(neighbours[cell]))]
            cell = exits[cell]
        cell = start
        while not in_tree[cell]:
            in_tree[cell] = True
            join(cell, exits[cell])
            cell = exits[cell]

    dead_ends = [cell for cell, exits in enumerate(opened) if len(exits) == 1]
    n_opened = int(braid * len(dead_ends) + 0.5)
    for cell in itertools.islice(generator.shuffled(dead_ends), n_opened):
        if len(opened[cell]) == 1:  # False if a neighbour was opened to it before
            closed = [beside for beside in neighbours[cell] if beside not in opened[cell]]
            join(cell, closed[generator.below(len(closed))])
    return opened


def lit_cells(opened: list[list[int]], reach: int) -> list[int]:
    """Returns few cells such that every cell is at most `reach` steps from one of them.

    Repeats: take the cell furthest from cell 0 that no light reaches, and put a light `reach` steps
    nearer to cell 0. In a perfect maze this gives the minimum number of lights.
    """
    parents, order = {0: 0}, [0]
    for cell in order:
        for neighbour in opened[cell]:
            if neighbour not in parents:
                parents[neighbour] = cell
                order.append(neighbour)
    lit, reached = [], set()
    for cell in reversed(order):
        if cell in reached:
            continue
        for _ in range(reach):
            cell = parents[cell]
        lit.append(cell)
        near = {cell}
        for _ in range(reach):
            near |= {neighbour for cell in near for neighbour in opened[cell]}
        reached |= near
    return sorted(lit)


def generate(
    seed: int, size: int = 8, corridor: float = 1.0, thickness: float = 0.2, braid: float = 0.0
) -> dotdict:
    """Returns the maze of a seed: a geometry of one room.

    Walls are the faces that are visible from inside, each as long as it is straight. A cell of the
    masks is at most 0.2 m wide. One row or column of cells runs along the middle of each corridor,
    so the masks of corridors of any width are connected. Arguments are those of the source `maze`;
    lengths are rounded to a millimetre. Raises ValueError if the maze would be too large.
    """
    wide, thick = round(1000 * corridor), round(1000 * thickness)
    pitch = wide + thick
    reach = (START + size * pitch) / 1000 + 1  # rounding to cells adds less than a metre
    if reach > geometry.MAX_EXTENT:
        raise ValueError(
            f"a maze of size={size}, corridor={corridor:g}, thickness={thickness:g} is too large: "
            f"it reaches {reach:g} m, but the limit is {geometry.MAX_EXTENT:g} m"
        )
    opened = passages(size, braid, PortableGenerator(seed))
    # wall and corridor lines alternate; row 0 is at the bottom
    grid = np.full((2 * size + 1, 2 * size + 1), WALL, np.int8)
    grid[1::2, 1::2] = INDOORS
    a, b = np.array([(a, b) for a, exits in enumerate(opened) for b in exits]).T
    grid[a // size + b // size + 1, a % size + b % size + 1] = INDOORS
    lines = np.cumsum([0] + [thick, wide] * size + [thick])

    per_cell = -(-pitch // round(1000 * geometry.RES))
    side, middle = pitch / per_cell, thick + wide / 2
    shift = (np.ceil((START + middle) / side - 0.5) + 0.5) * side - middle
    walls = (segments(lines, lines, grid, INDOORS) + shift) / 1000
    masks = geometry.masks(walls, [], side / 1000)
    centers = (np.arange(len(masks)) + 0.5) * side - shift
    at = np.searchsorted(lines, centers)  # 0 before the first line, so the grid is framed
    inside = np.pad(grid, 1)[np.ix_(at, at)][::-1] == INDOORS
    masks[inside & (masks == 0)] = 1

    lit = np.array(lit_cells(opened, min(2, LIT // pitch)))
    lights = np.stack([lit % size, lit // size], 1) * pitch + middle + shift
    return dotdict(
        id=seed,
        walls=walls.astype(np.float32),
        lights=(lights / 1000).astype(np.float32),
        masks=masks,
        res=side / 1000,
    )
