"""An environment of Gymnasium with a mask in `info`, which raises for forbidden actions."""

import gymnasium
import numpy as np


class Strict(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(4)

    def __init__(self):
        self.mask, self.age = np.ones(4, np.int8), 0

    def _info(self):
        self.mask = self.np_random.integers(0, 2, 4, dtype=np.int8)
        self.mask[self.np_random.integers(4)] = 1
        return {"action_mask": self.mask}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.age = 0
        return np.zeros(2, np.float32), self._info()

    def step(self, action):
        if not self.mask[action]:
            raise ValueError(f"action {action} is forbidden by {self.mask}")
        self.age += 1
        return np.zeros(2, np.float32), float(action), False, self.age == 9, self._info()


gymnasium.register("Strict-v0", Strict)
