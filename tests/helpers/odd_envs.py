"""Environments of Gymnasium with odd lives: `env.id=tests.helpers.odd_envs:OddCrash-v0`.

Workers import this module, so without PyTorch.
"""

import os

import gymnasium
import numpy as np
from gymnasium import spaces


class Odd(gymnasium.Env):
    """Observes the number of steps. Truncated after 10, with numbers in the last info."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space, action_space = spaces.Box(0, 1e6, (1,)), spaces.Discrete(2)
    limit = 10

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        is_over = self.count == self.limit
        return np.full(1, self.count, np.float32), 1.0, False, is_over, self.info(is_over)

    def info(self, is_over):
        return {}


class OneKey(Odd):
    """Its actions are a dict of one space."""

    action_space = spaces.Dict(press=spaces.Discrete(2))


class Crash(Odd):
    """Fails in one of 100 steps."""

    def step(self, action):
        if self.np_random.random() < 1 / 100:
            raise OSError("simulator does not answer")
        return super().step(action)


class CrashInReset(Odd):
    def reset(self, seed=None, options=None):
        raise KeyError("map")


class Exits(Odd):
    """Ends its process in the second episode, as a fault in C would."""

    n_steps = 0

    def step(self, action):
        self.n_steps += 1
        if self.n_steps == 12:
            os._exit(7)
        return super().step(action)


class CloseFails(Odd):
    def close(self):
        raise RuntimeError("viewer already gone")


class Scores(Odd):
    """Has numbers in the last info, and in others."""

    def info(self, is_over):
        more = {"is_success": True, "a-b": np.float32(2), "return": 5} if is_over else {}
        return {"x": self.count, "words": "a", "array": np.zeros(2), **more}


class ManyScores(Odd):
    def info(self, is_over):
        return {f"n{i}": i for i in range(18)} | {"is_success": np.bool_(False)}


class Endless(Odd):
    limit = -1


class BuildsRenderer(Odd):
    """Makes its renderer in the constructor."""

    def __init__(self, render_mode=None):
        super().__init__(render_mode)
        self.frame = np.full((8, 8, 3), 9, np.uint8) if render_mode == "rgb_array" else None

    def render(self):
        return self.frame


class Joins:
    """Two agents, as PettingZoo's; the second joins after 2 steps. They earn the number of steps,
    and observe it, from 5 on. Truncated after 5.
    """

    metadata, possible_agents = {"render_fps": 5}, ["first", "second"]

    def observation_space(self, agent):
        return spaces.Discrete(9, start=5)

    def action_space(self, agent):
        return spaces.Discrete(3)

    def reset(self, seed=None, options=None):
        self.agents, self.count = self.possible_agents[:1], 0
        return {"first": np.int64(5)}, {}

    def step(self, actions):
        self.count += 1
        self.agents = self.possible_agents[: 1 + (self.count >= 2)]
        seen = dict.fromkeys(self.agents, np.int64(5 + self.count))
        flags = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, self.count == 5)
        return seen, dict.fromkeys(actions, float(self.count)), *flags, {}


for _kind in [kind for kind in vars().values() if isinstance(kind, type) and issubclass(kind, Odd)]:
    gymnasium.register(f"Odd{_kind.__name__}-v0", _kind)
