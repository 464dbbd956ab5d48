#!/usr/bin/env bash
# SuperSuit 3.11.0: under `pad_action_space_v0` each action that an agent does not have is its action 0. One with two
# actions beside one with five takes action 0 in four of five cases, and a policy that is drawn at random, as in
# the beginning of training, hardly ever takes its other one; entropy counts five.
# Seen: 0, 1, 2, 3 and 4 reach it as 0, 1, 0, 0 and 0.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q supersuit==3.11.0 pettingzoo==1.27.0 gymnasium==1.0.0
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
import supersuit
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv


class Env(ParallelEnv):
    metadata, render_mode, possible_agents = {"name": "env"}, None, ["short", "long"]

    def observation_space(self, agent):
        return Box(0, 1, (1,))

    def action_space(self, agent):
        return Discrete({"short": 2, "long": 5}[agent])

    def reset(self, seed=None, options=None):
        self.agents = [*self.possible_agents]
        return {agent: np.zeros(1, np.float32) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions):
        taken.append(int(actions["short"]))
        each = [dict.fromkeys(self.agents, value) for value in (0.0, False, False)]
        return {agent: np.zeros(1, np.float32) for agent in self.agents}, *each, {a: {} for a in self.agents}


taken = []
env = supersuit.pad_action_space_v0(Env())
env.reset()
for action in range(env.action_space("short").n):
    env.step({"short": action, "long": action})
print("0 to 4 are taken as", taken)
assert taken == [0, 1, 0, 0, 0]
END
