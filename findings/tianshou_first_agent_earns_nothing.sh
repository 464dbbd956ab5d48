#!/usr/bin/env bash
# Tianshou 2.0.1 with PettingZoo 1.27.0: of two agents that act at once, only the second learns from its rewards. Its
# PettingZooEnv steps one agent after the other and returns the rewards of that turn alone; PettingZoo pays all of
# them in the last one's turn, where the learner of the first has no step. `env.last()` has the right sum.
# Seen, rock, paper, scissors, where one wins what the other loses: all 15 one-step targets without discount of
# player_0 are 0, those of player_1 are its rewards.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q tianshou==2.0.1 pettingzoo==1.27.0 pygame==2.6.1 gymnasium==1.4.0 torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
import torch
from pettingzoo.classic import rps_v2
from tianshou.algorithm.modelfree.dqn import DQN, DiscreteQLearningPolicy
from tianshou.algorithm.multiagent.marl import MultiAgentOffPolicyAlgorithm
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, PettingZooEnv


class Values(torch.nn.Embedding):
    def forward(self, obs, state=None, info=None):
        return super().forward(torch.as_tensor(obs)), state


def learner():
    policy = DiscreteQLearningPolicy(model=Values(4, 3), action_space=game.action_space)
    return DQN(policy=policy, optim=AdamOptimizerFactory(lr=1e-3), gamma=0.0)


game, buffer = PettingZooEnv(rps_v2.env()), VectorReplayBuffer(100, 1)
both = MultiAgentOffPolicyAlgorithm(algorithms=[learner(), learner()], env=game)
env = DummyVectorEnv([lambda: PettingZooEnv(rps_v2.env())])
Collector(both, env, buffer).collect(n_episode=1, random=True, reset_before_collect=True)
batch, indices = buffer.sample(0)
actions = np.array(batch.act).reshape(15, 2)
won = (actions[:, 1] - actions[:, 0] + 1) % 3 - 1  # by player_1: paper, 1, beats rock, 0, and so on
batches = both._preprocess_batch(batch, buffer, indices)
targets = [batches[name].returns.ravel().tolist() for name in ("player_0", "player_1")]
print("player_1 won:", won.tolist(), "targets:", *targets)
assert targets == [[0] * 15, won.tolist()] and won.any()
END
