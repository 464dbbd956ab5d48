"""A board game in bytes, without floor plans or engine, from a file outside the repository.

It is trained, evaluated and recorded like any other environment.
"""

import json
import sys

import pytest

from megastep.agents.cli import evaluate, record, train
from megastep.agents.runs import checkpoint

BOARD = '''
import torch
from matplotlib.figure import Figure

from megastep import arrdict, spaces


class Board:
    """One of three squares is lit. Choosing it gives a reward of 1. An episode has six turns."""

    n_agents, fps = 1, 4
    obs_space = spaces.MultiImage(1, 1, 1, 3, dtype=torch.uint8)
    action_space = spaces.MultiDiscrete(1, 3)

    def __init__(self, n_envs: int = 16, *, seed=1, device="cpu", turns: int = 6):
        self.n_envs, self.device, self.turns = n_envs, torch.device(device), turns
        self.start = seed + torch.arange(n_envs, device=self.device)
        self.age = torch.zeros_like(self.start)
        self.right = torch.zeros(n_envs, device=self.device)

    def lit(self):
        return (self.start + self.age) % 3

    def reset(self):
        return self._world(torch.ones_like(self.age, dtype=torch.bool), 0 * self.right)

    def step(self, decision):
        hit = (decision.actions[:, 0] == self.lit()).float()
        return self._world(self.age == self.turns, hit)

    def _world(self, reset, hit):
        self.age.add_(1).masked_fill_(reset, 0)
        self.right.add_(hit).masked_fill_(reset, 0.0)
        board = torch.nn.functional.one_hot(self.lit(), 3).byte() * 255
        ends = self.age == self.turns
        return arrdict.arrdict(
            obs=board.view(self.n_envs, 1, 1, 1, 3),
            reward=hit.masked_fill(reset, 0.0),
            reset=reset,
            terminal=ends,
            truncated=torch.zeros_like(ends),
            metrics=arrdict.arrdict(right=self.right / self.turns),
        )

    def check(self):
        pass

    def state(self, e=0):
        return arrdict.arrdict(lit=self.lit()[e].clone())

    @classmethod
    def plot_state(cls, state):
        figure = Figure(figsize=(2, 1))
        figure.subplots().bar([0, 1, 2], [int(state.lit) == i for i in range(3)])
        return figure
'''
WORDS = ["env=board:Board", "env.n_envs=32", "agent.width=16", "device=cpu"]
WORDS += ["learner.n_steps=16", "learner.n_minibatches=2", "learner.lr=0.01", "samples=20000"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "board.py").write_text(BOARD)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("board", None)


def test_a_board_game_is_trained_evaluated_and_recorded(folder, capsys):
    assert train.main([*WORDS, "folder=run"]) == 0
    rows = [json.loads(line) for line in (folder / "run/metrics.jsonl").read_text().splitlines()]
    ended = [row for row in rows if row["episode/count"]]
    assert all(row["episode/right"] == pytest.approx(row["episode/return"] / 6) for row in ended)
    assert ended[-1]["episode/right"] > 0.9 > ended[0]["episode/right"], "1/3 by chance"
    config = checkpoint.load_latest(folder / "run/checkpoints").config
    assert config["spaces"]["obs"].endswith("W=3, dtype=torch.uint8)")

    assert evaluate.main(["run=run", "episodes=30", "device=cpu"]) == 0
    path = folder / f"run/evaluations/board-test-{rows[-1]['samples']}.json"
    table = json.loads(path.read_text())
    assert table["title"].startswith("board: 30 episodes, after ")
    assert table["rows"][0]["homes"] is None
    trained, random = (row["metrics"]["right"] for row in table["rows"])
    assert trained["lower"] > 0.8 > 0.5 > random["upper"] > random["mean"] > random["lower"] > 0.1
    output = capsys.readouterr().out
    assert "right" in output and "geometry=" not in output

    assert record.main(["run=run", "steps=4", "file=board.mp4", "device=cpu"]) == 0
    assert (folder / "board.mp4").stat().st_size > 500
