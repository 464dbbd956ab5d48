#!/usr/bin/env bash
# NAVIX 0.7.4: tasks with MiniGrid's names are other tasks. Every episode ends after 100 steps, where MiniGrid's
# limits grow with the room (640 in DoorKey-8x8); the reward of a goal is 1, however late; and DoorKey without
# "Random" has six layouts in all, as the agent always begins in the same corner.
# Seen: limits of 100 against 256, 640 and 270; layouts of DoorKey-5x5 in 60 seeds: 6 against 35.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q navix==0.7.4 minigrid==3.2.0 gymnasium==1.4.0
JAX_PLATFORMS=cpu "$folder/bin/python" -W ignore - <<'END'
import gymnasium
import jax
import minigrid  # noqa: F401
import navix
import numpy as np
from minigrid.wrappers import FullyObsWrapper

TASKS = ["Empty-8x8-v0", "DoorKey-8x8-v0", "KeyCorridorS3R3-v0"]
theirs = [navix.make(f"Navix-{task}").max_steps for task in TASKS]
original = [gymnasium.make(f"MiniGrid-{task}").unwrapped.max_steps for task in TASKS]
print("limits:", theirs, "MiniGrid's:", original)
assert theirs == [100, 100, 100] and original == [256, 640, 270]

env = navix.make("Navix-DoorKey-5x5-v0")
reset, layouts = jax.jit(env.reset), set()
for seed in range(60):
    state = reset(jax.random.PRNGKey(seed)).state
    places = [np.asarray(kind.position).tobytes() for kind in state.entities.values()]
    layouts.add((np.asarray(state.grid).tobytes(), *places))
mini = FullyObsWrapper(gymnasium.make("MiniGrid-DoorKey-5x5-v0"))
originals = {mini.reset(seed=seed)[0]["image"].tobytes() for seed in range(60)}
print("layouts:", len(layouts), "MiniGrid's:", len(originals))
assert len(layouts) == 6 and len(originals) == 35

env = navix.make("Navix-Empty-5x5-v0")
step, at = jax.jit(env.step), env.reset(jax.random.PRNGKey(0))
for action in [6] * 80 + [2, 2, 1, 2, 2]:  # waits, then goes ahead, right, and ahead
    at = step(at, action)
print("reward after", int(at.t), "steps:", float(at.reward))
assert float(at.reward) == 1 and int(at.t) == 85
END
