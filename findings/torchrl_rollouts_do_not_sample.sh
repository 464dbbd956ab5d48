#!/usr/bin/env bash
# TorchRL 0.14.1: a stochastic policy, made by `ProbabilisticActor` without further settings, is greedy in
# `env.rollout` and samples in a collector. So returns of rollouts are of another policy than the one that learns,
# unless they run under set_exploration_type(ExplorationType.RANDOM), or the actor gets default_interaction_type.
# Seen, a policy of CartPole with chances 0.48 and 0.52: rollouts take the second action in all of 200 steps.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torchrl==0.14.1 torch==2.13.0 numpy==2.2.6 gymnasium==1.4.0
"$folder/bin/python" -W ignore - <<'END'
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, GymEnv, set_exploration_type
from torchrl.modules import OneHotCategorical, ProbabilisticActor

torch.manual_seed(0)
linear = torch.nn.Linear(4, 2)
linear.weight.data.zero_()
linear.bias.data.copy_(torch.tensor([0.48, 0.52]).log())
module = TensorDictModule(linear, in_keys=["observation"], out_keys=["logits"])
policy = ProbabilisticActor(module, in_keys=["logits"], distribution_class=OneHotCategorical)
env = GymEnv("CartPole-v1")


def share(steps):
    return round(steps["action"][:, 1].double().mean().item(), 2)


rollout = share(env.rollout(200, policy, break_when_any_done=False))
collected = share(next(iter(Collector(env, policy, frames_per_batch=200, total_frames=200))))
with set_exploration_type(ExplorationType.RANDOM):
    sampled = share(env.rollout(200, policy, break_when_any_done=False))
print("share of the second action, rollout:", rollout, "collector:", collected, "RANDOM:", sampled)
assert rollout == 1 and 0.4 < collected < 0.65 and 0.4 < sampled < 0.65
END
