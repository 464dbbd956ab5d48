#!/usr/bin/env bash
# Gymnasium 1.4.0: MaxAndSkipObservation gives an observation of the step before where an episode ends within
# the skipped frames. It reads the last two frames of each four, which were not written then. At a time limit a
# learner bootstraps from what was seen before the action, and a film misses how it ended.
# Seen, frames numbered by time, skip 4: an episode cut off after frame 6 ends with an observation of 4, after
# frame 8 with one of 8.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q gymnasium==1.4.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import gymnasium
import numpy as np
from gymnasium.wrappers import MaxAndSkipObservation, TimeLimit


class Clock(gymnasium.Env):
    """Shows how many frames have passed."""

    observation_space = gymnasium.spaces.Box(0, 255, (1,), np.uint8)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, seed=None, options=None):
        self.frames = 0
        return np.zeros(1, np.uint8), {}

    def step(self, action):
        self.frames += 1
        return np.full(1, self.frames, np.uint8), 0.0, False, False, {}


def last_observation(limit):
    env = MaxAndSkipObservation(TimeLimit(Clock(), limit), skip=4)
    env.reset()
    truncated = False
    while not truncated:
        obs, _, _, truncated, _ = env.step(0)
    return int(obs[0])


seen = {limit: last_observation(limit) for limit in (5, 6, 7, 8)}
print("last observation by the frame that ended it:", seen)
assert seen == {5: 4, 6: 4, 7: 7, 8: 8}
END
