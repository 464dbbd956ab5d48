"""Environments and wrappers of Gymnasium that keep more than an episode, or draw from global
generators. Workers import this module, so without PyTorch.
"""

import random

import gymnasium
import numpy as np
from gymnasium import spaces

from tests.helpers.odd_envs import Odd


class Draws(Odd):
    """Observes a number of NumPy's global generator and one of Python's."""

    observation_space, draws = spaces.Box(0, 1, (2,)), True

    def __init__(self, render_mode=None):
        super().__init__(render_mode)
        self.offset = np.random.rand() if self.draws else 0.0

    def numbers(self):
        numbers = [np.random.rand(), random.random()] if self.draws else [0.0, 0.0]
        return np.array([*numbers, self.offset], np.float32)[:2]

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return self.numbers(), {}

    def step(self, action):
        return self.numbers(), *super().step(action)[1:]


class Seven(Odd):
    """Observes 7 in its third step, where there are 4 observations."""

    observation_space = spaces.Discrete(4)

    def reset(self, seed=None, options=None):
        return 0, super().reset(seed=seed)[1]

    def step(self, action):
        _, *more = super().step(action)
        return 7 if self.count == 3 else 1, *more


gymnasium.register("Draws-v0", Draws)
gymnasium.register("Seven-v0", Seven)


class Level(gymnasium.Wrapper):
    """Adds a level to the observation, which rises with each episode; and counts its steps."""

    def __init__(self, env):
        super().__init__(env)
        self.memory, self.steps = Memory(), 0

    def reset(self, **settings):
        self.steps = 0
        obs, info = self.env.reset(**settings)
        return obs + self.memory.count, info

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.steps += 1
        if terminated or truncated:
            self.memory.count += 1
            self.memory.var += 1.0
        return obs + self.memory.count, reward, terminated, truncated, info


class Memory:
    """Running statistics."""

    def __init__(self):
        self.mean, self.var, self.count = 0.5, np.zeros(2), 0


class Small(gymnasium.RewardWrapper):
    def reward(self, reward):
        return reward / 10
