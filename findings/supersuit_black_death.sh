#!/usr/bin/env bash
# SuperSuit 3.11.0: under `black_death_v3` the death of an agent is never a `done` of its lane, and the end
# of an episode comes one step after the last real step, with a reward of 0. A learner on
# `pettingzoo_env_to_vec_env_v1` bootstraps through the death, from the value of a black image.
# Seen: an agent dies on step 2 and the game ends on step 4: no lane is done before step 5, then both are.
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


class Pair(ParallelEnv):
    """Two agents with a reward of 1 a step. The first dies on step 2, the second on step 4."""

    metadata = {"name": "pair"}
    possible_agents = ["first", "second"]
    render_mode = None

    def observation_space(self, agent):
        return Box(0, 9, (1,))

    def action_space(self, agent):
        return Discrete(2)

    def reset(self, seed=None, options=None):
        self.steps, self.agents = 0, list(self.possible_agents)
        zero = {agent: np.zeros(1, np.float32) for agent in self.agents}
        return zero, {agent: {} for agent in self.agents}

    def step(self, actions):
        self.steps += 1
        acting = self.agents
        dead = {agent: self.steps == (2 if agent == "first" else 4) for agent in acting}
        self.agents = [agent for agent in acting if not dead[agent]]
        obs = {agent: np.full(1, self.steps, np.float32) for agent in acting}
        never = dict.fromkeys(acting, False)
        return obs, dict.fromkeys(acting, 1.0), dead, never, {agent: {} for agent in acting}


env = supersuit.pettingzoo_env_to_vec_env_v1(supersuit.black_death_v3(Pair()))
env.reset(seed=0)
rewards, dones = [], []
for _ in range(5):
    _, reward, terminated, truncated, _ = env.step(np.zeros(2, int))
    rewards.append(reward.tolist())
    dones.append([bool(a or b) for a, b in zip(terminated, truncated)])
print("rewards:", rewards, "dones:", dones)
assert rewards == [[1, 1], [1, 1], [0, 1], [0, 1], [0, 0]]
assert dones == 4 * [[False, False]] + [[True, True]]
END
