"""What bots know of floor plans: where an agent fits, and how long the ways are.

D layouts, P plans, M nodes of all plans, L targets per plan, K exits per
node, n lanes.

A plan is divided into squares of 0.3 m. The spot of a square that is furthest from walls is a node,
if an agent fits there. Ways lead from nodes to targets: landmarks, the nodes of blocks of squares
that are furthest from walls, or the goals of PointGoal.
"""

from typing import Any, cast

import numpy as np
import torch
from torch.nn.functional import pad

from megastep import engine
from megastep.dotdict import dotdict
from megastep.geodesics import MAX_GOALS, PathGraph

CELL = 0.05  # metres, of the grid of clearances
SQUARE, BLOCK = 6, 4  # cells per side of a square, squares per side of a block, by default
CLEAR = 0.005  # metres between walls and an agent on a node
MOST = 0.5  # metres; clearances beyond are not told apart
LEVELS = 255 / MOST  # of clearances, per metre
AT_ONCE = 16  # plans that are surveyed together
#: Squares from a node's to those where it has exits.
EXITS = [(x, y) for x in range(-2, 3) for y in range(-2, 3)]
EXITS += [(2 * x, 2 * y) for x, y in EXITS if max(abs(x), abs(y)) == 2]
FAR, NEAR = 17, 6  # points of a straight way of 2.4 m or 0.9 m that are tested for room
TIGHT = 0.035  # metres that a straight way may be nearer to a wall than an agent: half a cell
WIDE, NARROW = 0.08, 3.0  # metres beside an agent that a way is better for, each worth as many
BLOCKED = 1e3  # metres that a wall in the way is worth


class Plans:
    """Clearances and shortest paths in the layouts of a scenery. Constant.

    Args:
        spawns: (D, S, 2) metres, where agents begin. Nodes can be reached from there.
        radius: of the agents, in metres.
        goals: (D, L, 2) metres, the targets. Default: landmarks.
        block: squares per side of a landmark's block.

    Attributes:
        of_layout: (D,) int64, the plan of each layout; layouts with the same walls share one.
        nodes: (M, 2) float32 metres.
        exits: (M, K) int32, nodes near each.
        metres: (M, K) float16, lengths of the straight ways there, as `straight` has them.
        targets: (P, L, 2) float32 metres.
        lengths: (M, L) float16, metres from each node to each target of its plan by the shortest
            path; infinite where there is none.

    Raises:
        ValueError: a layout has no walls.
    """

    # in slots, so that neither checkpoints nor CUDA graphs copy what never changes
    __slots__ = (
        *("beside", "exits", "lengths", "metres", "nodes", "of_layout", "targets"),
        *("_clearances", "_corners", "_origins", "_radius", "_squares"),
    )

    def __init__(
        self,
        scenery: engine.Scenery,
        spawns: torch.Tensor,
        radius: float,
        goals: torch.Tensor | None = None,
        block: int = BLOCK,
    ):
        device, lines = scenery.device, cast(Any, scenery.layouts.lines)
        walls = [lines[d].cpu().numpy() for d in range(len(lines))]
        if not all(map(len, walls)):
            raise ValueError("it walks in homes with walls, and a geometry here has none")
        keys = [part.tobytes() for part in walls]
        if goals is not None:
            keys = [key + part.cpu().numpy().tobytes() for key, part in zip(keys, goals)]
        # a graph takes as many points of each home, so homes of a size together
        layouts = sorted(dict(zip(keys, range(len(keys)))).values(), key=lambda d: _area(walls[d]))
        numbers = {keys[d]: number for number, d in enumerate(layouts)}
        self.of_layout = torch.tensor([numbers[key] for key in keys], device=device)
        surveys = []
        for first in range(0, len(layouts), AT_ONCE):
            chunk = layouts[first : first + AT_ONCE]
            graph = PathGraph([dotdict(walls=walls[d], id=d) for d in chunk], radius, device)
            targets = None if goals is None else [*goals[chunk]]
            surveys += _surveys(graph, [*spawns[chunk, :MAX_GOALS]], targets, block)
        origins, clearances, squares, nodes, targets, lengths = zip(*surveys)
        self.nodes, self._radius = torch.cat(nodes), radius
        firsts = np.cumsum([0, *map(len, nodes)]).tolist()
        squares = [torch.where(s < 0, -1, s + first) for s, first in zip(squares, firsts)]
        self._origins, self._clearances = torch.stack(origins), _stack(clearances)
        self._squares, self.targets = _stack(squares, -1), _stack(targets)
        width = self.targets.shape[1]
        self.lengths = torch.cat(
            [pad(part, (0, width - part.shape[1]), value=torch.inf) for part in lengths]
        )
        on: dict = dict(dtype=torch.float32, device=device)
        self._corners = torch.tensor([(0, 0), (0, 1), (1, 0), (1, 1)], **on)
        offsets = CELL * SQUARE * torch.tensor(EXITS, **on)
        self.beside = offsets[[max(map(abs, pair)) < 2 for pair in EXITS]]
        exits = [self._exits(plan, part, offsets) for plan, part in enumerate(nodes)]
        self.exits, self.metres = map(torch.cat, zip(*exits))

    def _exits(self, plan, nodes, offsets) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the nodes (m, K) near those of a plan (m, 2), and the lengths of the ways."""
        plan = torch.full((len(nodes),), plan, device=nodes.device)
        exits = self.around(plan, nodes[:, None] + offsets)
        metres = self.straight(plan, nodes, self.nodes[exits])
        return exits.int().clamp(min=0), torch.where(exits < 0, torch.inf, metres).half()

    def clearances(self, plan: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Returns the metres (n, ...) to the nearest wall from points (n, ..., 2) of plans (n,), in
        steps of 5 cm, at most half a metre.
        """
        levels = self._at(self._clearances, plan, points, CELL)
        return levels.float() / LEVELS

    def straight(
        self, plan: torch.Tensor, start: torch.Tensor, ends: torch.Tensor, n_samples: int = FAR
    ) -> torch.Tensor:
        """Returns the lengths (n, K) of straight ways from points (n, 2) to others (n, K, 2), more
        if they are narrow, and more than `BLOCKED` if there is a wall.
        """
        fraction = torch.linspace(0, 1, n_samples + 1, device=start.device)[1:, None]
        offsets = ends - start[:, None]
        points = start[:, None, None] + fraction * offsets[:, :, None]
        room = self.clearances(plan, points).amin(-1) - self._radius
        lengths = offsets.norm(dim=-1) + NARROW * (WIDE - room).clamp(min=0)
        return lengths + BLOCKED * (room < -TIGHT)

    def smooth_clearances(self, plan: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Returns clearances that are interpolated between the centres of cells."""
        corner = points - CELL / 2
        origin = self._origins[plan].view(-1, *[1] * (points.ndim - 2), 2)
        fraction = ((corner - origin) / CELL).frac()[..., None, :]
        weights = torch.where(self._corners > 0, fraction, 1 - fraction).prod(-1)
        beside = corner[..., None, :] + CELL * self._corners
        return (weights * self.clearances(plan, beside)).sum(-1)

    def around(self, plan: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Returns the nodes (n, ...) in the squares of points (n, ..., 2), -1 if there is none."""
        return self._at(self._squares, plan, points, CELL * SQUARE)

    def _at(self, grids, plan, points, size) -> torch.Tensor:
        shape = len(plan), *[1] * (points.ndim - 2)
        cells = (points - self._origins[plan].view(*shape, 2)) / size
        column, row = cells.long().unbind(-1)
        height, width = grids.shape[1:]
        row, column = row.clamp(0, height - 1), column.clamp(0, width - 1)
        return grids.view(-1)[(plan.view(shape) * height + row) * width + column]


def _area(walls) -> float:
    return np.prod(np.ptp(walls, (0, 1)))


def _stack(tensors, value=0) -> torch.Tensor:
    """Returns tensors (h, w) of different sizes as one, padded at their ends."""
    height, width = np.max([tensor.shape for tensor in tensors], 0).tolist()
    ends = [(0, width - tensor.shape[1], 0, height - len(tensor)) for tensor in tensors]
    return torch.stack([pad(tensor, end, value=value) for tensor, end in zip(tensors, ends)])


def _surveys(graph, spawns, targets, block) -> list[tuple]:
    """Returns for each home of a graph origin (2,), clearances (H, W) uint8, squares (h, w) int64,
    nodes (m, 2), targets (l, 2) and lengths (m, l). Nodes are numbered from 0.

    A node can be reached from one of the spawn points (S, 2) of the home.
    """
    grids, landmarks = [_grid(graph, d, block) for d in range(len(graph.geometries))], []
    spots = [points[fits] for _, _, _, fits, points in grids]
    reached = [part.isfinite().any(1) for part in _lengths(graph, spawns, spots)]
    nodes, all_squares = [part[is_node] for part, is_node in zip(spots, reached)], []
    for (_, _, room, fits, points), is_reached in zip(grids, reached):
        is_node = fits.masked_scatter(fits, is_reached)
        squares = is_node.flatten().cumsum(0).view(fits.shape) - 1
        all_squares.append(squares.masked_fill(~is_node, -1))
        room, square = _best(room.masked_fill(~is_node, 0), block)
        landmarks.append(points.view(-1, 2)[square[room > 0]])
    targets = landmarks if targets is None else targets
    lengths = [part.half() for part in _lengths(graph, targets, nodes)]
    origins, clearances = ([grid[i] for grid in grids] for i in (0, 1))
    return [*zip(origins, clearances, all_squares, nodes, targets, lengths)]


def _grid(graph, d, block) -> tuple[torch.Tensor, ...]:
    """Returns origin and clearances of a home's plan, and of its squares the spot furthest from
    walls: its clearance (h, w), whether an agent fits there (h, w), and where it is (h, w, 2).
    """
    walls, side, device = graph.geometries[d].walls, CELL * SQUARE, graph.device
    low, high = walls.min((0, 1)) - side, walls.max((0, 1))  # the first squares are outside
    columns, rows = block * (np.ceil((high - low) / side / block).astype(int) + 1)
    x, y = (CELL * (np.arange(SQUARE * n) + 0.5) for n in (columns, rows))
    points = graph.tensor(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2) + low, np.float32)
    home = torch.full((len(points),), d, dtype=torch.int32, device=device)
    relative = points - graph.tensor(graph.origins[d], np.float32)
    clearances = graph.clearances(relative, home, MOST).view(SQUARE * rows, SQUARE * columns)
    room, spot = _best(clearances, SQUARE)
    levels = (clearances * LEVELS).to(torch.uint8)
    return graph.tensor(low, np.float32), levels, room, room > graph.radius + CLEAR, points[spot]


def _best(values, side) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the highest of the values (H, W) in each square, (h, w), and its flat index."""
    rows, columns = (n // side for n in values.shape)
    parts = values.view(rows, side, columns, side).transpose(1, 2).reshape(rows, columns, -1)
    highest, index = parts.max(-1)
    row = torch.arange(rows, device=values.device)[:, None] * side + index // side
    column = torch.arange(columns, device=values.device) * side + index % side
    return highest, row * values.shape[1] + column


def _lengths(graph, goals, points) -> list[torch.Tensor]:
    """Returns the lengths of the shortest paths, (k, g) for each home, from points (k, 2) to goals
    (g, 2). A graph takes equally many of each home, so the last ones are repeated.
    """

    def of_all(parts) -> np.ndarray:
        most = max(map(len, parts))
        parts = [part.cpu()[torch.arange(most).clamp(max=len(part) - 1)] for part in parts]
        return torch.stack(parts).numpy() - graph.origins[:, None]

    every, points_of_all = of_all(goals), of_all(points)
    n_searches = -(-every.shape[1] // MAX_GOALS)
    searched = np.array_split(every, n_searches, axis=1)
    tables = torch.cat([graph.lengths(part, points_of_all) for part in searched], 1)
    return [table[: len(g), : len(p)].T for table, g, p in zip(tables, goals, points)]
