"""Parallel environments of PettingZoo: agents as lanes, and agents that are out before others, or
not there.
"""

import sys
import types

import numpy as np
import pytest
import torch

from megastep import contract
from megastep.agents.cli import evaluate, train
from megastep.agents.evaluation import playing, statistics
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.arrdict import arrdict
from megastep.envs import PettingZoo
from megastep.hosting.env_error import BadValue

spaces = pytest.importorskip("gymnasium.spaces")


class Relay:
    """Agent a is out after a + 1 steps; the last is truncated. Observes and earns the steps, times
    10 to the power of a.
    """

    metadata, possible_agents = {"render_fps": 5}, ["one", "two", "three"]

    def __init__(self, render_mode=None, odd=False):
        self.odd = odd

    def observation_space(self, agent):
        return spaces.Box(0, 10_000, (1 + (self.odd and agent == "two"),))

    def action_space(self, agent):
        return spaces.Discrete(4)

    def reset(self, seed=None, options=None):
        self.agents, self.count = self.possible_agents[:], 0
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


ID = f"{__name__}:Relay"


def test_each_agent_ends_by_itself_and_the_environment_with_the_last():
    """One that is out begins anew in each step, without learning, until the others are out."""
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
        "reset": [[1, 1, 1], 3 * [0], [1, 0, 0], [1, 1, 0], [1, 1, 1], 3 * [0]],
        "terminal": [3 * [0], [1, 0, 0], [0, 1, 0], 3 * [0], 3 * [0], [1, 0, 0]],
        "truncated": [*3 * [3 * [0]], [0, 0, 1], 3 * [0], 3 * [0]],
        "learns": [[1, 1, 1], [0, 1, 1], [0, 0, 1], 3 * [0], [1, 1, 1], [0, 1, 1]],
    }.items():
        values = torch.stack([world[key].float().view(6) for world in worlds])
        assert values.tolist() == [[*row, *row] for row in rows], key
    assert (env.state(1).frame == 1).all()


class Habits(Relay):
    """Ends after 3 steps, as `habit` says."""

    def __init__(self, habit):
        super().__init__()
        self.habit, self.n_resets = habit, 0

    def reset(self, seed=None, options=None):
        super().reset()
        self.n_resets += 1
        if self.habit == "absent" and self.n_resets % 2:  # the first is the constructor's
            self.agents = ["one", "three"]
        return self.facts(), {}

    def step(self, actions):
        assert actions.keys() == set(self.agents)
        self.count += 1
        if self.habit == "joins" and self.count == 2:
            self.agents = self.possible_agents[:]
        if self.habit == "joins" and self.count == 1:
            self.agents = ["one", "three"]
        is_over = self.count == 3
        ends = {agent: is_over for agent in self.agents}
        ends = {"__all__": is_over} if self.habit == "all" else ends
        result = self.facts(), {agent: 1.0 for agent in self.agents}, ends, {}, {}
        self.agents = [] if is_over and self.habit not in ("keeps", "all") else self.agents
        return result


def played(habit, n_steps=8):
    env = PettingZoo(1, id=f"{__name__}:Habits", kwargs={"habit": habit}, device="cpu")
    worlds = contract.rollout(env, n_steps)
    return env, lambda key: [world[key].int().tolist() for world in worlds]


@pytest.mark.parametrize("habit", ["keeps", "all", "none"])
def test_environment_is_over_when_all_agents_have_ended(habit):
    """Whatever `agents` says, and if only `__all__` says so."""
    _, rows = played(habit)
    assert rows("terminal") == [[int(t % 4 == 3)] * 3 for t in range(9)]
    assert rows("reset") == [[int(t % 4 == 0)] * 3 for t in range(9)]


def test_absent_agents_do_not_learn_and_are_not_counted():
    env, rows = played("absent", 8)
    assert rows("learns") == [
        *3 * [[1, 1, 1]],
        [0, 0, 0],
        *3 * [[1, 0, 1]],
        [0, 0, 0],
        [1, 1, 1],
    ]
    episodes = playing.first_episodes(env, RandomActions(env.action_space))  # of an odd reset
    assert episodes.learns.tolist() == [True, False, True]
    assert episodes.returns[episodes.learns].tolist() == [3, 3]
    (row,) = statistics.summaries(episodes)
    assert row["return"] == 3 and row["lanes"] == 2


def test_agents_may_leave_and_join():
    _, rows = played("joins", 4)
    assert rows("learns") == [[1, 1, 1], [1, 0, 1], [1, 1, 1], [0, 0, 0], [1, 1, 1]]
    assert rows("truncated")[1] == [0, 1, 0] and rows("reset")[2] == [0, 1, 0]


def test_an_agent_that_is_not_there_yet_has_an_observation_of_its_space():
    env = PettingZoo(1, id="tests.helpers.odd_envs:Joins", device="cpu")
    actions = arrdict(actions=torch.zeros(2, 1, dtype=torch.int64))
    worlds = [env.reset(), *(env.step(actions) for _ in range(3))]
    assert [world.obs[:, 0].tolist() for world in worlds] == [[0, 0], [1, 0], [2, 2], [3, 3]]
    assert [world.learns.tolist()[1] for world in worlds] == [False, False, True, True]


class Turns(Relay):
    """As turn-based environments are, which have no parallel `step`."""

    agent_iter = None


def convertible():
    env = Turns()
    env.metadata = {"is_parallelizable": True}
    return env


def test_turns_that_can_be_together_are_converted(monkeypatch):
    conversions = types.SimpleNamespace(aec_to_parallel=lambda env: Free())
    monkeypatch.setitem(sys.modules, "pettingzoo.utils.conversions", conversions)
    contract.rollout(PettingZoo(1, id=f"{__name__}:convertible", device="cpu"), 8)


def test_agents_that_differ_or_act_in_turns_are_refused():
    with pytest.raises(ValueError, match="it is turn-based, and agents have to act together; name"):
        PettingZoo(1, id=f"{__name__}:Turns", device="cpu")
    for settings, message in (
        ({"odd": True}, "the spaces of one and two differ, but one policy acts for all"),
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


class Forbids(Relay):
    """Raises for forbidden actions. The mask is in `info` or, with `seen`, in the observation; the
    second agent has none after a step.
    """

    def __init__(self, seen=False, n=4):
        super().__init__()
        self.seen, self.n, self.random = seen, n, np.random.default_rng(1)

    def observation_space(self, agent):
        place, mask = super().observation_space(agent), spaces.Box(0, 1, (self.n,), np.int8)
        return spaces.Dict(place=place, action_mask=mask) if self.seen else place

    def drawn(self, places):
        self.masks = {agent: self.random.integers(0, 2, self.n, np.int8) for agent in places}
        for mask in self.masks.values():
            mask[self.random.integers(self.n)] = 1
        if self.count and not self.seen:
            self.masks.pop("two", None)
        masks = {agent: dict(action_mask=mask) for agent, mask in self.masks.items()}
        if self.seen:
            return {agent: masks[agent] | dict(place=place) for agent, place in places.items()}, {}
        return places, masks

    def reset(self, seed=None, options=None):
        return self.drawn(super().reset()[0])

    def step(self, actions):
        for agent, action in actions.items():
            if agent in self.masks and not self.masks[agent][action]:
                raise ValueError(f"{action} is forbidden by {self.masks[agent]}")
        indices = {agent: self.possible_agents.index(agent) for agent in actions}
        places, *others, _ = super().step(indices)
        places, infos = self.drawn(places)
        return places, *others, infos


def test_masks_reach_training_and_evaluation(here):
    name = f"{__name__}:Forbids"
    for seen in (False, True):
        env = PettingZoo(2, id=name, kwargs={"seen": seen}, device="cpu")
        assert contract.rollout(env, 9)[0].mask.shape == (6, 1, 4)
    words = [
        *("env=pettingzoo", f"env.id={name}", "env.kwargs.seen=true", "env.n_envs=4"),
        *("learner.n_steps=8", "learner.n_minibatches=2", "agent.width=8", "samples=480"),
    ]
    assert train.main([*words, "folder=run", "device=cpu"]) == 0
    assert evaluate.main(["run=run", "episodes=4", "baseline=random"]) == 0


def test_a_mask_that_does_not_fit_is_a_sentence():
    with pytest.warns(UserWarning, match=r"Forbids: info\['action_mask'\] is not used"):
        env = PettingZoo(1, id=f"{__name__}:Forbids", kwargs={"n": 5}, device="cpu")
    assert "mask" not in env.reset()
    env = PettingZoo(1, id=f"{__name__}:Forbids", device="cpu")
    env.vector.envs[0].n = 5
    with pytest.raises(BadValue, match=r"environment 0, one: .* \(5,\), and before it had \(4"):
        env.reset()


class Doubled:
    """A wrapper as PettingZoo's: rewards count twice."""

    def __init__(self, env):
        self.env = self.unwrapped = env

    def __getattr__(self, name):
        return getattr(self.env, name)

    def step(self, actions):
        seen, rewards, *others = self.env.step(actions)
        return seen, {agent: 2 * reward for agent, reward in rewards.items()}, *others


def test_wrappers_of_the_package_are_around_each_environment():
    plain, doubled = PettingZoo(2, id=ID), PettingZoo(2, id=ID, wrappers=(f"{__name__}:Doubled",))
    decision = arrdict(actions=torch.arange(3).repeat(2)[:, None])
    plain.reset(), doubled.reset()
    reward = plain.step(decision).reward
    assert bool(reward.any()) and torch.equal(doubled.step(decision).reward, 2 * reward)
