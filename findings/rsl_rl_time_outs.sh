#!/usr/bin/env bash
# rsl_rl 5.5.1: where a time limit ends an episode, PPO adds the value of the observation before the last step, not
# of the one after it, which its environments have no place for. The target of that step is reward + gamma V(o_t):
# the value is told to equal gamma times itself, whatever the last step led to.
# Seen, gamma 0.5, values equal to observations: a step from 8 that is cut off has a return of 4 with no reward,
# and so whether it led to 0 or to 100; one that goes on to 100 has 50.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torch==2.13.0 tensordict==0.15.3 numpy==2.2.6 gitpython tensorboard==2.21.0
"$folder/bin/pip" install -q --no-deps rsl-rl-lib==5.5.1
"$folder/bin/python" -W ignore - <<'END'
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict


def observation(value):
    return TensorDict({"policy": torch.tensor([[float(value)]])}, batch_size=[1])


class Itself(MLPModel):
    """A critic whose value is the observation."""

    def forward(self, obs, *_, **__):
        return obs["policy"]


def first_return(following, is_cut):
    obs, groups = observation(8), {"actor": ["policy"], "critic": ["policy"]}
    noise = {"class_name": "GaussianDistribution"}
    actor = MLPModel(obs, groups, "actor", 1, (4,), distribution_cfg=noise)
    storage = RolloutStorage("rl", 1, 2, obs, [1])
    ppo = PPO(actor, Itself(obs, groups, "critic", 1, (4,)), storage, gamma=0.5, lam=0.0)
    for before, after, over in (8, following, is_cut), (following, 0, False):
        ppo.act(observation(before))
        ends = torch.tensor([over])
        ppo.process_env_step(observation(after), torch.zeros(1), ends, {"time_outs": ends})
    ppo.compute_returns(observation(0))
    return storage.returns[0].item()


cut, cut_at_100, goes_on = first_return(0, True), first_return(100, True), first_return(100, False)
print("cut off before 0 and 100:", cut, cut_at_100, "going on to 100:", goes_on)
assert (cut, cut_at_100, goes_on) == (4, 4, 50)
END
