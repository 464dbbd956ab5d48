"""Parallel environments of PettingZoo: agents as lanes, and agents that are out before others."""

import numpy as np
import pytest
import torch

from megastep import contract
from megastep.agents.cli import evaluate, train
from megastep.arrdict import arrdict
from megastep.envs import PettingZoo

spaces = pytest.importorskip("gymnasium.spaces")


class Relay:
    """Agent a is out after a + 1 steps; the last is truncated. Observes and earns the steps, times
    10 to the power of a.
    """

    metadata, possible_agents = {"render_fps": 5}, ["one", "two", "three"]

    def __init__(self, render_mode=None, odd=False, late=False):
        self.odd, self.late = odd, late

    def observation_space(self, agent):
        return spaces.Box(0, 10_000, (1 + (self.odd and agent == "two"),))

    def action_space(self, agent):
        return spaces.Discrete(4)

    def reset(self, seed=None, options=None):
        self.agents, self.count = self.possible_agents[: 2 if self.late else 3], 0
        return self.facts(), {}

    def facts(self):
        return {agent: np.array([self.value(agent)], np.float32) for agent in self.agents}

    def value(self, agent):
        return self.count * 10 ** self.possible_agents.index(agent)

    def step(self, actions):
        assert actions.keys() == set(self.agents)
        assert all(action == self.possible_agents.index(a) for a, action in actions.items())
        self.count += 1
        rewards = {agent: self.value(agent) for agent in self.agents}
        out = {agent: self.count > self.possible_agents.index(agent) for agent in self.agents}
        terminated = {agent: out[agent] and agent != "three" for agent in self.agents}
        truncated = {agent: out[agent] and agent == "three" for agent in self.agents}
        seen, self.agents = self.facts(), [agent for agent in self.agents if not out[agent]]
        return seen, rewards, terminated, truncated, {}

    def render(self):
        return np.full((8, 8, 3), self.count, np.uint8)

    def close(self):
        pass


class Undrawn(Relay):
    def __init__(self, odd=False):
        super().__init__(odd=odd)


ID = f"{__name__}:Relay"


def test_all_agents_of_an_environment_end_together():
    env = PettingZoo(2, id=ID, device="cpu")
    contract.check_environment(env)
    decision = arrdict(actions=torch.tensor([[0], [1], [2]] * 2))
    worlds = [env.reset()]
    for _ in range(5):
        contract.check_world(env, worlds[-1], worlds[-2] if len(worlds) > 1 else None)
        worlds.append(env.step(decision))
    assert env.n_agents == 3 and env.fps == 5
    for key, rows in {
        "obs": [[0, 0, 0], [1, 10, 100], [1, 20, 200], [1, 20, 300], [0, 0, 0], [1, 10, 100]],
        "reward": [[0, 0, 0], [1, 10, 100], [0, 20, 200], [0, 0, 300], [0, 0, 0], [1, 10, 100]],
        "reset": [[1, 1, 1], 3 * [0], 3 * [0], 3 * [0], [1, 1, 1], 3 * [0]],
        "terminal": [*3 * [3 * [0]], [1, 1, 0], 3 * [0], 3 * [0]],
        "truncated": [*3 * [3 * [0]], [0, 0, 1], 3 * [0], 3 * [0]],
    }.items():
        values = torch.stack([world[key].float().view(6) for world in worlds])
        assert values.tolist() == [[*row, *row] for row in rows], key
    assert (env.state(1).frame == 1).all()


def test_constructor_without_a_render_mode():
    env = PettingZoo(1, id=f"{__name__}:Undrawn", device="cpu")
    assert env.reset().reset.all()
    with pytest.raises(ValueError, match="renders no images"):
        env.state(0)


def test_agents_that_differ_or_come_later_are_refused():
    for settings, message in (
        ({"odd": True}, "the spaces of one and two differ, but one policy acts for all"),
        ({"late": True}, "some of its agents come later"),
        ({"odder": True}, "with env.kwargs={'odder': True}: TypeError: .*odder"),
    ):
        with pytest.raises(ValueError, match=message):
            PettingZoo(2, id=ID, kwargs=settings, device="cpu")
    for name, message in (
        (None, "env.id is missing"),
        ("pettingzoo.sisl", "'pettingzoo.sisl' is not an import path"),
        ("no_such_package:parallel_env", "no_such_package:parallel_env cannot be imported"),
    ):
        with pytest.raises(ValueError, match=message):
            PettingZoo(2, id=name, device="cpu")


class Free(Relay):
    def step(self, actions):
        return super().step({agent: self.possible_agents.index(agent) for agent in actions})


def test_trains_and_evaluates(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [
        *("env=pettingzoo", f"env.id={__name__}:Free", "device=cpu", "env.n_envs=4"),
        *("learner.n_steps=8", "learner.n_minibatches=2", "agent.width=8", "samples=96"),
    ]
    assert train.main([*words, "folder=run"]) == 0
    assert evaluate.main(["run=run", "episodes=4", "against=random"]) == 0
