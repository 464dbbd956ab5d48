#!/usr/bin/env bash
# VMAS 1.5.2 and mpe2 1.1.1: "simple_spread" of three agents is two tasks. In one state the reward of VMAS is six times
# that of MPE, as each landmark counts once per agent. Full force is 5 times as strong in MPE, and moves an agent
# one step later. Returns, and agents, of the one say nothing about the other.
# Seen: rewards of -4.046 and -0.674; an agent that is pushed ahead is, after each step, at 0.01, 0.0275 and 0.0506
# in VMAS, and at 0, 0.05 and 0.1375 in MPE.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q vmas==1.5.2 mpe2==1.1.1 torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
import torch
import vmas
from mpe2 import simple_spread_v3

PLACES = {"agents": [(0.0, 0.0), (0.9, 0.0), (-0.5, 0.5)], "landmarks": [(0.3, 0.3), (-0.4, 0.2), (0.1, -0.6)]}


def play_vmas(force, n_steps):
    """Returns the first agent's last reward, and its x after each step."""
    env, xs = vmas.make_env("simple_spread", num_envs=1, continuous_actions=True, device="cpu"), []
    env.reset()
    for kind, places in PLACES.items():
        for entity, place in zip(getattr(env.world, kind), places):
            entity.set_pos(torch.tensor([place]), batch_index=None)
    for _ in range(n_steps):
        _, rewards, *_ = env.step([torch.tensor([[force, 0.0]])] * 3)
        xs.append(round(env.world.agents[0].state.pos[0, 0].item(), 4))
    return round(rewards[0].item(), 3), xs


def play_mpe(force, n_steps):
    env, xs = simple_spread_v3.parallel_env(N=3, continuous_actions=True), []
    env.reset(seed=0)
    world = env.unwrapped.world
    for kind, places in PLACES.items():
        for entity, place in zip(getattr(world, kind), places):
            entity.state.p_pos, entity.state.p_vel = np.array(place), np.zeros(2)
    for _ in range(n_steps):
        _, rewards, *_ = env.step({agent: np.array([0, 0, force, 0, 0], np.float32) for agent in env.agents})
        xs.append(round(float(world.agents[0].state.p_pos[0]), 4))
    return round(rewards["agent_0"], 3), xs


(vmas_reward, _), (mpe_reward, _) = play_vmas(0.0, 1), play_mpe(0.0, 1)
(_, vmas_xs), (_, mpe_xs) = play_vmas(1.0, 3), play_mpe(1.0, 3)
print("rewards:", vmas_reward, mpe_reward, "places:", vmas_xs, mpe_xs)
assert (vmas_reward, mpe_reward) == (-4.046, -0.674)
assert (vmas_xs, mpe_xs) == ([0.01, 0.0275, 0.0506], [0, 0.05, 0.1375])
END
