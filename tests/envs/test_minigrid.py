"""MiniGrid: equal to the original, which draws our random numbers, in every observation, reward and
end.
"""

import functools

import gymnasium
import numpy as np
import pytest
import torch

from megastep import envs
from megastep.arrdict import arrdict
from megastep.envs.minigrid.tasks import TASKS
from tests.helpers.pong_twins import philox

minigrid = pytest.importorskip("minigrid", minversion="3.2", reason="needs minigrid of Python 3.11")
KINDS = "key", "ball", "box"
COLOURS = "red", "green", "blue", "purple", "yellow", "grey"


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


@functools.cache
def original(id):
    return gymnasium.make(id, disable_env_checker=True).unwrapped


def mission_of(text):
    """Returns the one-hot mission (18,) of a text."""
    words, row = text.split(), np.zeros(18)
    places = [i for i, word in enumerate(words) if word in COLOURS]
    for part, place in enumerate(places):
        row[9 * part + COLOURS.index(words[place])] = 1
        if words[place + 1] in KINDS:
            row[9 * part + 6 + KINDS.index(words[place + 1])] = 1
    return row


def assert_equal(world, e, obs, reward, terminated, truncated):
    ours = world.obs.image[e, 0].permute(2, 1, 0).numpy()  # x, y, channel
    assert np.array_equal(ours, obs["image"])
    assert int(world.obs.direction[e]) == obs["direction"]
    if "mission" in world.obs:
        assert np.array_equal(world.obs.mission[e, 0].numpy(), mission_of(obs["mission"]))
    assert float(world.reward[e]) == np.float32(reward)
    assert (bool(world.terminal[e]), bool(world.truncated[e])) == (
        terminated,
        truncated and not terminated,
    )


def play(id, n_envs, n_episodes, seed=3):
    """Compares episodes of random actions, often forward. Returns how many succeed."""
    ours, theirs = envs.MiniGrid(n_envs, id=id, seed=seed, device="cpu"), original(id)
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
    successes = 0
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
                successes += reward > 0
            t += 1
            done += 1
    return successes


@pytest.mark.parametrize("id", TASKS)
def test_equals_the_original(id):
    play(id, n_envs=2, n_episodes=1)
