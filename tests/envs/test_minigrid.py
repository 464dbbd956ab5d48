"""MiniGrid: equal to the original, which draws our random numbers, in every observation, reward and
end.
"""

import json
import re

import numpy as np
import pytest
import torch
from torch.utils._pytree import tree_leaves as leaves

from megastep import envs
from megastep.agents.cli import evaluate, train
from megastep.arrdict import arrdict
from megastep.envs.minigrid.original import as_here
from megastep.envs.minigrid.tasks import TASKS
from tests.helpers.minigrids import original
from tests.helpers.pages import ROOT
from tests.helpers.pong_twins import philox


class OurDraws:
    """Takes the place of the original's NumPy generator: an environment's draws, in order."""

    def __init__(self, lane, seed):
        self.lane, self.seed, self.n_drawn = lane, seed, 0

    def integers(self, low, high):
        word = philox(self.lane, self.n_drawn, self.seed)[0]
        self.n_drawn += 1
        return low + (word * int(high - low) >> 32)

    def choice(self, items):
        return items[self.integers(0, len(items))]

    def shuffle(self, items):
        for i in reversed(range(1, len(items))):
            j = self.integers(0, i + 1)
            items[i], items[j] = items[j], items[i]


def assert_equal(world, e, obs, reward, terminated, truncated):
    theirs = as_here(obs, "mission" in world.obs)
    assert theirs.keys() == world.obs.keys()
    assert all(np.array_equal(world.obs[key][e, 0], value) for key, value in theirs.items())
    assert float(world.reward[e]) == np.float32(reward)
    assert (bool(world.terminal[e]), bool(world.truncated[e])) == (
        terminated,
        truncated and not terminated,
    )


def play(id, n_envs, n_episodes, seed=3, rooms=None):
    """Compares episodes of random actions, often forward."""
    ours = envs.MiniGrid(n_envs, id=id, rooms=rooms, seed=seed, device="cpu")
    theirs = original(id, rooms)
    n_actions = ours.task.n_actions
    weights = torch.ones(n_actions)
    weights[2] = 3
    random = torch.Generator().manual_seed(1)
    length = ours.task.limit + 1
    actions = torch.multinomial(
        weights.expand(n_envs, -1), length * n_episodes, True, generator=random
    )
    worlds = [ours.reset().clone()]
    for t in range(length * n_episodes):
        worlds.append(ours.step(arrdict(actions=actions[:, t, None])).clone())
    for e in range(n_envs):
        draws = OurDraws(e, seed)
        theirs._np_random = draws
        t = done = 0
        while done < n_episodes:
            obs, _ = theirs.reset()
            assert worlds[t].reset[e]
            assert_equal(worlds[t], e, obs, 0, False, False)
            terminated = truncated = False
            while not (terminated or truncated):
                obs, reward, terminated, truncated, _ = theirs.step(int(actions[e, t]))
                t += 1
                assert_equal(worlds[t], e, obs, reward, terminated, truncated)
            t += 1
            done += 1


@pytest.mark.parametrize("id", TASKS)
def test_equals_the_original(id):
    play(id, n_envs=1, n_episodes=1)


def test_rooms_equal_the_originals():
    play("MiniGrid-MultiRoom-N6-v0", n_envs=4, n_episodes=2, rooms=(1, 3))


@pytest.mark.nightly
@pytest.mark.parametrize("id", TASKS)
def test_equals_the_original_for_a_thousand_episodes(id):
    play(id, n_envs=50, n_episodes=20, seed=7)


@pytest.mark.cuda
@pytest.mark.parametrize("id", TASKS)
def test_gpu_has_the_bits_of_the_cpu(id):
    worlds = []
    actions = torch.randint(3, (200, 300, 1), generator=torch.Generator().manual_seed(1))
    for device in "cpu", "cuda":
        env = envs.MiniGrid(300, id=id, device=device)
        env.reset()
        worlds.append([env.step(arrdict(actions=a.to(device))).clone() for a in actions])
        worlds[-1].append(arrdict(cells=env.cells, games=env.games))
    for ours, theirs in zip(*worlds, strict=True):
        assert all((a == b.cpu()).all() for a, b in zip(leaves(ours), leaves(theirs), strict=True))


@pytest.mark.slow
def test_agents_play_here_as_in_the_original(tmp_path, monkeypatch):
    pytest.importorskip("minigrid", minversion="3.2", reason="needs minigrid of Python 3.11")
    monkeypatch.chdir(tmp_path)
    id, wrapper = "MiniGrid-Empty-Random-5x5-v0", "megastep.envs.minigrid.original:AsHere"
    here, there = (
        ["env=minigrid", f"env.id={id}"],
        ["env=gymnasium", f"env.id=minigrid:{id}", f"env.wrappers=[{wrapper}]"],
    )
    small = "agent.encoder=categories agent.core=none agent.width=32 device=cpu".split()
    for name, trained_in, samples in ("here", here, 25000), ("there", there, 2000):
        words = [*small, "env.n_envs=32", f"samples={samples}", f"folder={name}"]
        assert train.main([*trained_in, *words]) == 0
        rows = []
        for played_in in here, there:
            words = [f"run={name}", "episodes=64", "device=cpu", "baseline=none"]
            assert evaluate.main([*played_in, *words]) == 0
            tables = (tmp_path / name / "evaluations").glob("*.json")
            newest = max(tables, key=lambda path: path.stat().st_mtime_ns)
            rows.append(json.loads(newest.read_text())["rows"][0])
        (a, b) = rows
        assert a["lower"] < b["upper"] and b["lower"] < a["upper"]
        if name == "here":
            assert min(row["metrics"]["success"]["mean"] for row in rows) > 0.9


def empty_rooms(seed):
    """Two rooms of 5 x 4 cells, with a goal in different corners."""
    cells = torch.full((2, 4, 5), 2 + 16 * 5)
    cells[:, 1:3, 1:4] = 1
    cells[0, 2, 3] = cells[1, 1, 3] = 8 + 16
    return cells, torch.tensor([(1, 1, 0), (1, 1, 0)])


def broken_rooms(seed):
    cells, starts = empty_rooms(seed)
    cells[1, 1, 1] = 12
    return cells, starts


def test_grids_of_a_users_function(device):
    env = envs.MiniGrid(64, layouts=f"{__name__}:empty_rooms", limit=20, device=device)
    env.reset()
    goals = (env.cells == 8 + 16).flatten(1).int().argmax(1)
    assert set(goals.tolist()) == {8, 13}
    forward = arrdict(actions=torch.full((64, 1), 2, device=device))
    env.step(forward)
    world = env.step(forward)
    is_ahead = goals == 8
    assert torch.equal(world.terminal, is_ahead) and torch.equal(
        world.metrics.success == 1, is_ahead
    )
    assert world.reward[is_ahead].tolist() == [np.float32(1 - 0.9 * 2 / 20)] * int(is_ahead.sum())


@pytest.mark.parametrize(
    "settings, words",
    [
        (dict(id="MiniGrid-DoorKey-9x9-v0"), "near are MiniGrid-DoorKey-"),
        (dict(layouts=f"{__name__}:broken_rooms"), "grid 1 has a cell that is no kind"),
        (dict(rooms=(1, 2)), "fewest and the most rooms of a MultiRoom task"),
        (dict(id="MiniGrid-MultiRoom-N6-v0", rooms=(3, 2)), "fewest and the most rooms"),
    ],
)
def test_bad_settings(settings, words):
    with pytest.raises(ValueError, match=words):
        envs.MiniGrid(2, device="cpu", **settings)


@pytest.mark.parametrize("value", [-(2**31), -1, 2**31 - 1])
def test_what_is_written_into_games_ends_no_process(value, device):
    for id in "MiniGrid-RedBlueDoors-6x6-v0", "MiniGrid-Dynamic-Obstacles-6x6-v0":
        env = envs.MiniGrid(2, id=id, device=device)
        env.reset()
        for row in range(len(env.games)):
            env.games[row] = value
            env.step(arrdict(actions=torch.full((2, 1), 2, device=device)))


def test_picture(tmp_path):
    env = envs.MiniGrid(1, id="MiniGrid-KeyCorridorS3R3-v0", device="cpu")
    env.reset()
    env.display().savefig(tmp_path / "grid.png")
    assert (tmp_path / "grid.png").stat().st_size > 2000


def test_the_pages_example(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "grids.md").read_text(), re.S)
    (tmp_path / "my_grids.py").write_text(code)
    words = ["experiment=minigrid", "env.layouts=my_grids:corners", "env.limit=100", "device=cpu"]
    words += ["env.n_envs=16", "agent.width=8", "samples=2000", "folder=run"]
    assert train.main(words) == 0 and (tmp_path / "run" / "metrics.jsonl").exists()
