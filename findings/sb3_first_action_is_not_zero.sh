#!/usr/bin/env bash
# Stable-Baselines3 2.9.2: in an environment with the actions `Discrete(3, start=5)`, which are 5, 6 and 7, PPO and
# A2C take 0, 1 and 2. No error says so: an environment that takes any number moves otherwise, or not at all, and
# the agent learns that. (`check_env` knows, if one calls it; DQN raises an error in its first update.)
# Seen: the actions of both are 0, 1 and 2, and none of them is in the space.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q stable-baselines3==2.9.2 torch==2.13.0
"$folder/bin/python" -W ignore - <<'END'
import gymnasium
import numpy as np
import stable_baselines3
from gymnasium.spaces import Box, Discrete


class Env(gymnasium.Env):
    observation_space, action_space = Box(0, 1, (2,)), Discrete(3, start=5)

    def reset(self, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        taken.add(int(action))
        return np.zeros(2, np.float32), 0.0, False, False, {}


for algorithm in (stable_baselines3.PPO, stable_baselines3.A2C):
    taken = set()
    algorithm("MlpPolicy", Env(), seed=1, device="cpu").learn(200)
    print(algorithm.__name__, "takes", taken, "of", Env.action_space)
    assert taken == {0, 1, 2}
    assert not any(Env.action_space.contains(action) for action in taken)
END
