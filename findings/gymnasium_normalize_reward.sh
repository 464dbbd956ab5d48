#!/usr/bin/env bash
# Gymnasium 1.4.0: NormalizeReward's running return ends at terminations only. It runs on through time
# limits, so that the scale of rewards depends on the episode before; and a terminal step forgets the past
# one step too early: its own return is the bare reward.
# Seen, gamma 0.5, reward 1: the first step after a limit has a return of 1.875, after a termination 1.5.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q gymnasium==1.4.0
"$folder/bin/python" -W ignore - <<'END'
import gymnasium
import numpy as np


class Three(gymnasium.Env):
    """Episodes of three steps with a reward of 1."""

    observation_space = gymnasium.spaces.Box(0, 1, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, is_limit):
        self.is_limit = is_limit

    def reset(self, seed=None, options=None):
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        ended = self.steps == 3
        return np.zeros(1, np.float32), 1.0, ended and not self.is_limit, ended and self.is_limit, {}


def returns(is_limit):
    env, seen = gymnasium.wrappers.NormalizeReward(Three(is_limit), gamma=0.5), []
    for _ in range(2):
        env.reset()
        for _ in range(3):
            env.step(0)
            seen.append(float(np.ravel(env.discounted_reward)[0]))
    return seen


print("limits:", returns(True), "terminations:", returns(False))
assert returns(True)[:4] == [1, 1.5, 1.75, 1.875]
assert returns(False)[:4] == [1, 1.5, 1, 1.5]
END
