#!/usr/bin/env bash
# Brax 0.14.2: in training all episodes of a lane begin in the same state. Its wrapper keeps that of the lane's first
# reset, and goes back to it at each end, so that what `reset` draws at random, a pose or a goal, is drawn once per
# lane and run: 64 lanes see 64 beginnings, however long they train.
# Seen: three lanes of inverted_pendulum begin differently, and their first three episodes begin alike to the bit.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q brax==0.14.2 jax==0.10.2 mujoco==4.0.0 mujoco-mjx==3.17.0
"$folder/bin/python" -W ignore - <<'END'
import jax
import jax.numpy as jnp
import numpy as np
from brax import envs

env = envs.create("inverted_pendulum", episode_length=5, auto_reset=True, batch_size=3)
state = jax.jit(env.reset)(jax.random.PRNGKey(0))
starts, step, n_ended = [np.asarray(state.obs)], jax.jit(env.step), 0
for _ in range(10):
    state = step(state, jnp.zeros((3, 1)))
    if state.done.all():
        starts.append(np.asarray(state.obs))
print("first observations, an episode per block:", *starts, sep="\n")
assert len(starts) == 3 and all((start == starts[0]).all() for start in starts)
assert len({*map(tuple, starts[0].tolist())}) == 3
END
