"""The planner that knows only what it has seen."""

import numpy as np
import pytest
import torch

pytest.importorskip("scipy")
import planner

from megastep import engine, geometries
from megastep.envs.pointgoal.path_graph import PathGraph


def walk(walls, start, goal, yaw):
    grid = planner.Grid(walls)
    start, goal = grid.cell(np.array(start)), grid.cell(np.array(goal))
    shortest = grid.paths(grid.blocked(walls), goal)[0][start]
    return shortest, planner.Planner(walls, grid, start, goal, yaw).walk(100)


def room(*more):
    corners = np.array([[0, 0], [6, 0], [6, 6], [0, 6]], float)
    return np.concatenate(
        [np.stack([corners, np.roll(corners, -1, 0)], 1), np.array(more, float).reshape(-1, 2, 2)]
    )


def test_an_empty_room_is_crossed_straight():
    shortest, walked = walk(room(), (1, 3), (5, 3), yaw=2.0)
    assert walked == pytest.approx(shortest) == pytest.approx(4.0)


def test_a_dead_end_costs_what_could_not_be_seen():
    # a pocket, open towards the start, whose back is 12 m away and so out of sight
    pocket = [(1, 2), (13, 2)], [(1, 4), (13, 4)], [(13, 2), (13, 4)]
    around = [(-1, -1), (16, -1)], [(16, -1), (16, 7)], [(16, 7), (-1, 7)], [(-1, 7), (-1, -1)]
    shortest, walked = walk(np.array([*pocket, *around], float), (0, 3), (15, 3), yaw=0.0)
    assert shortest == pytest.approx(15, abs=1)
    # in until the back is in view, out again and around
    assert 15 + 2 * 2 < walked < 2 * 13 + 20


def test_no_path_is_infinite():
    closed = [(4, 0), (4, 6)]
    shortest, walked = walk(room(closed), (1, 3), (5, 3), yaw=0.0)
    assert shortest == walked == np.inf


def test_shortest_paths_on_the_grid_are_those_of_the_environment():
    """Two programs: a grid with knight's moves, and a graph of corners."""
    rng, (home,) = np.random.default_rng(1), geometries.sample("homes", 1, "test", density=3.0)
    walls = np.asarray(home["walls"], float)
    grid, graph = planner.Grid(walls), PathGraph([home], engine.AGENT_RADIUS, torch.device("cpu"))
    free = ~grid.blocked(walls)
    cells = rng.choice(np.flatnonzero(free), 40, replace=False)
    points = np.stack([grid.centre(cell) for cell in cells]) - graph.origins[0]
    goals, starts = (
        torch.as_tensor(part[None], dtype=torch.float32) for part in (points[:4], points[4:])
    )
    exact = graph.lengths(goals.numpy(), starts.numpy()).numpy()[0]
    on_grid = np.stack([grid.paths(~free, cell)[0][cells[4:]] for cell in cells[:4]])
    both = np.isfinite(exact) & np.isfinite(on_grid) & (exact > 1)
    assert both.sum() > 50
    ratio = on_grid[both] / exact[both]
    assert 0.99 < ratio.min() and np.median(ratio) < 1.03
