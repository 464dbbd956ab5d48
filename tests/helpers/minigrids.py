"""The original MiniGrid, beside which tests put ours."""

import functools
import warnings
import zlib

import gymnasium
import numpy as np
import pytest
import torch

from megastep import envs
from megastep.envs.minigrid.original import mission_of
from megastep.envs.minigrid.tasks import LIBRARY, TASKS

CONSTANTS = LIBRARY.constants
DOORS = "OPEN_DOOR", "CLOSED_DOOR", "LOCKED_DOOR"  # by the original's states
N_BUCKETS = 32


@functools.cache
def original(id, rooms=None):
    kwargs = dict(zip(("minNumRooms", "maxNumRooms"), rooms or ()))
    pytest.importorskip("minigrid", minversion="3.2", reason="needs minigrid of Python 3.11")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a newer version of a task is there
        return gymnasium.make(id, disable_env_checker=True, **kwargs).unwrapped


# ---- Layouts: a row each of the cells, the agent's place and direction, and the mission ----


def our_layouts(id, n, seed=1):
    env = envs.MiniGrid(n, id=id, seed=seed, device="cpu")
    missions = env.reset().obs.get("mission", torch.zeros(n, 1, 18))[:, 0].numpy()
    return rows_of(env.cells.flatten(1).numpy(), env.games[:3].numpy(), missions)


def rows_of(cells, agents, missions):
    x, y, direction = agents
    columns = cells, 100 * y + x, direction, missions @ 2 ** np.arange(18)
    return np.column_stack(columns).astype(np.int64)


def original_layouts(id, n, seed=1, generator=None):
    """Draws them by the original's own generator, or another one."""
    env = original(id)
    env.reset(seed=seed)
    if generator is not None:
        env._np_random = generator(env.np_random)
    cells, agents, missions = [], [], []
    for _ in range(n):
        env.agent_pos, env.agent_dir = (-1, -1), -1
        env._gen_grid(env.width, env.height)
        cells.append([_cell(item) for item in env.grid.grid])
        agents.append((*env.agent_pos, env.agent_dir))
        missions.append(mission_of(env.mission if TASKS[id].has_mission else ""))
    return rows_of(np.array(cells), np.array(agents).T, np.array(missions))


def _cell(item):
    if item is None:
        return CONSTANTS["EMPTY"]
    kind, colour, state = item.encode()
    return (CONSTANTS[DOORS[state]] if item.type == "door" else kind) + 16 * colour


def p_value(a, b):
    """Returns the smallest p-value of chi-square tests of whether two samples of layouts (n, V)
    have one distribution, by Bonferroni's correction: of each variable alone, and of whole layouts,
    which are put into buckets.
    """
    both = [
        np.column_stack([x, [zlib.crc32(row.tobytes()) % N_BUCKETS for row in x]]) for x in (a, b)
    ]
    ps = [_p_of_one(*columns) for columns in zip(*(x.T for x in both), strict=True)]
    return min(1.0, min(ps) * len(ps))


def _p_of_one(a, b):
    values, codes = np.unique(np.concatenate([a, b]), return_inverse=True)
    parts = np.split(codes.ravel(), [len(a)])
    counts = np.stack([np.bincount(part, minlength=len(values)) for part in parts])
    is_rare = counts.sum(0) < 20
    counts = np.column_stack([counts[:, ~is_rare], counts[:, is_rare].sum(1)])
    counts = counts[:, counts.sum(0) > 0]
    from scipy.stats import chi2_contingency  # which takes a while to import

    return chi2_contingency(counts).pvalue if counts.shape[1] > 1 else 1.0
