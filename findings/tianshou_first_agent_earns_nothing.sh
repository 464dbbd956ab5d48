#!/usr/bin/env bash
# Tianshou 2.0.1 with PettingZoo 1.27.0: of two agents that act at once, only the second learns from its rewards. Its
# PettingZooEnv steps one agent after the other and returns the rewards of that turn alone; PettingZoo pays all of
# them in the last one's turn, where the learner of the first has no step. `env.last()` has the right sum.
# Seen: "a" is paid 1 a step and "b" 10; one-step targets without discount are 0 for "a", 10 for "b".
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q tianshou==2.0.1 pettingzoo==1.27.0 gymnasium==1.4.0 torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec
from tianshou.algorithm.modelfree.dqn import DQN, DiscreteQLearningPolicy
from tianshou.algorithm.multiagent.marl import MultiAgentOffPolicyAlgorithm
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, PettingZooEnv
from tianshou.utils.net.common import Net


class Pay(ParallelEnv):
    metadata, render_mode, possible_agents = {"name": "pay"}, None, ["a", "b"]
    observation_space, action_space = lambda self, agent: Box(0, 9, (1,)), lambda self, agent: Discrete(2)

    def reset(self, seed=None, options=None):
        self.agents, self.time = [*self.possible_agents], 0
        return {agent: np.zeros(1, np.float32) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions):
        self.time += 1
        names, is_over = self.agents, self.time == 4
        self.agents = [] if is_over else names
        observations, flags = {name: np.full(1, self.time, np.float32) for name in names}, dict.fromkeys(names, False)
        return observations, {"a": 1.0, "b": 10.0}, dict.fromkeys(names, is_over), flags, {name: {} for name in names}


def learner():
    policy = DiscreteQLearningPolicy(model=Net(state_shape=1, action_shape=2), action_space=Discrete(2))
    return DQN(policy=policy, optim=AdamOptimizerFactory(lr=1e-3), gamma=0.0)


env, buffer = DummyVectorEnv([lambda: PettingZooEnv(parallel_to_aec(Pay()))]), VectorReplayBuffer(100, 1)
both = MultiAgentOffPolicyAlgorithm(algorithms=[learner(), learner()], env=PettingZooEnv(parallel_to_aec(Pay())))
Collector(both, env, buffer).collect(n_episode=1, reset_before_collect=True)
batch, indices = buffer.sample(0)
batches = both._preprocess_batch(batch, buffer, indices)
targets = {agent: batches[agent].returns.ravel().tolist() for agent in "ab"}
turns = parallel_to_aec(Pay())
turns.reset()
paid = {"a": 0, "b": 0}
for agent in turns.agent_iter():
    _, reward, is_over, _, _ = turns.last()
    paid[agent] += reward
    turns.step(None if is_over else 0)
print("targets:", targets, "paid by last():", paid)
assert targets == {"a": [0] * 4, "b": [10] * 4} and paid == {"a": 4, "b": 40}
END
