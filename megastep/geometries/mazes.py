"""Mazes: square grids of cells, joined by openings as wide as the corridors.

A perfect maze has one way between any two cells. It is a spanning tree of its grid, drawn by
Wilson's algorithm ("Generating random spanning trees more quickly than the cover time", STOC 1996),
so all perfect mazes of a size are equally likely. A braided one has dead ends opened, which makes
loops. A seed gives the same bytes on every machine (see `homes.random_stream`).

Lengths here are in millimetres; a cell is the number row * size + column, row 0 at the bottom.
"""

import functools

import numpy as np

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.geometries.homes.portable_generator import PortableGenerator
from megastep.geometries.homes.walls import INDOORS, WALL, segments

COUNT = 5_000  # mazes of each kind, those of seeds 0 to 4,999; as many as there are homes
# Metres; an agent's disc and 5 cm on either side of it are 0.312 m wide, and where it spawns is a
# strip between those.
MIN_CORRIDOR = 0.32
START = 1_000  # mm; about where a maze begins
LIT = 3_000  # mm; walking so far, or two cells, from any cell there is a light
# Of memory per metre of wall, that is 20 texels, while an environment is made of it: Explorer takes
# 1,540 on a CPU.
BYTES_PER_METRE = 2_000


def checked(size: int, corridor: float, thickness: float) -> tuple[int, int]:
    """Corridor and thickness, given in metres, in mm. ValueError if agents or geometries could not
    be that small or large.
    """
    if size < 2:
        raise ValueError(f"size={size} cells are no maze: take 2 or more")
    if corridor < MIN_CORRIDOR:
        raise ValueError(
            f"corridor={corridor:g} m is too narrow for an agent: take {MIN_CORRIDOR:g} or more"
        )
    wide, thick = round(1000 * corridor), round(1000 * thickness)
    reach = (START + size * (wide + thick)) / 1000 + 1  # rounding to cells adds less than a metre
    if reach > geometry.MAX_EXTENT:
        raise ValueError(
            f"a maze of {size} x {size} cells, {corridor:g} m wide between walls of {thickness:g} "
            f"m, is too large: it reaches {reach:g} m, and {geometry.MAX_EXTENT:g} m is the limit"
        )
    return wide, thick


def bytes_each(size: int, corridor: float, thickness: float) -> float:
    """How much memory a maze takes at most: its masks, its walls, and the scenery made of them."""
    wider = thickness > corridor  # then an opening adds more wall than it takes
    n_openings = 2 * size * (size - 1) if wider else size * size - 1
    metres = 4 * size * size * corridor + 2 * n_openings * (thickness - corridor)
    pixels = (size * ((corridor + thickness) / geometry.RES + 1) + 15) ** 2
    return BYTES_PER_METRE * metres + 2 * pixels


@functools.lru_cache(maxsize=8)
def _neighbours(size):
    """The cells beside each cell, walls or not."""
    return [
        [
            row * size + column
            for row, column in ((i, j - 1), (i, j + 1), (i - 1, j), (i + 1, j))
            if 0 <= row < size and 0 <= column < size
        ]
        for i in range(size)
        for j in range(size)
    ]


def passages(size: int, braid: float, stream: PortableGenerator) -> list[list[int]]:
    """The cells that each cell opens to. Of the dead ends the share `braid` is opened, each to a
    random neighbour.
    """
    around = _neighbours(size)
    opened = [[] for _ in around]

    def join(a, b):
        opened[a].append(b)
        opened[b].append(a)

    in_tree = [False] * len(around)
    in_tree[stream.below(len(around))] = True
    for start in range(len(around)):
        # A random walk to the tree. Its last exit from each cell leads there without loops.
        exits, cell = {}, start
        while not in_tree[cell]:
            exits[cell] = around[cell][stream.below(len(around[cell]))]
            cell = exits[cell]
        cell = start
        while not in_tree[cell]:
            in_tree[cell] = True
            join(cell, exits[cell])
            cell = exits[cell]

    dead_ends = [cell for cell, others in enumerate(opened) if len(others) == 1]
    for k in range(int(braid * len(dead_ends) + 0.5)):
        at = k + stream.below(len(dead_ends) - k)
        dead_ends[k], dead_ends[at] = dead_ends[at], dead_ends[k]
        cell = dead_ends[k]
        if len(opened[cell]) == 1:  # or a neighbour has been opened to it
            closed = [other for other in around[cell] if other not in opened[cell]]
            join(cell, closed[stream.below(len(closed))])
    return opened


def lit_cells(opened: list[list[int]], reach: int) -> list[int]:
    """Few cells from which every cell is at most `reach` steps away.

    Of the cells that no light reaches yet, the one furthest from cell 0 gets a light, `reach` steps
    nearer to cell 0. In a perfect maze fewer lights would not do.
    """
    before, order = {0: 0}, [0]
    for cell in order:
        for other in opened[cell]:
            if other not in before:
                before[other] = cell
                order.append(other)
    chosen, reached = [], set()
    for cell in reversed(order):
        if cell in reached:
            continue
        for _ in range(reach):
            cell = before[cell]
        chosen.append(cell)
        ring = near = {cell}
        for _ in range(reach):
            ring = {other for cell in ring for other in opened[cell]} - near
            near = near | ring
        reached |= near
    return sorted(chosen)


def _painted(size, opened):
    """(2 size + 1, 2 size + 1) states of walls and corridors, in turn, row 0 at the bottom."""
    grid = np.full((2 * size + 1, 2 * size + 1), WALL, np.int8)
    grid[1::2, 1::2] = INDOORS
    pairs = [(a, b) for a, others in enumerate(opened) for b in others if a < b]
    a, b = np.array(pairs).T
    grid[a // size + b // size + 1, a % size + b % size + 1] = INDOORS
    return grid


def generate(
    seed: int, size: int = 8, corridor: float = 1.0, thickness: float = 0.2, braid: float = 0.0
) -> dotdict:
    """The maze of a seed, any integer: `size` x `size` cells, `corridor` metres wide between walls
    `thickness` metres thick, both to a millimetre, with the share `braid` of its dead ends opened.

    A geometry of one room. Walls are the faces that can be seen from inside, each as long as it is
    straight. A cell of the masks is at most 0.2 m wide, and one in each row and column of them lies
    in the middle of each corridor, so that corridors of any width are connected there.
    """
    wide, thick = checked(size, corridor, thickness)
    pitch = wide + thick
    opened = passages(size, braid, PortableGenerator(seed))
    grid = _painted(size, opened)
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
