#!/usr/bin/env bash
# gymnax 1.0.1: MountainCarContinuous-v0 is not Gymnasium's: its car does not lose its speed at the left wall, since
# the stop is tested at the goal. The car stays at the wall until full throttle has used that speed up.
# Seen, with both cars on their way into the wall and full throttle from then on: Gymnasium's leaves the wall after a
# step and is at the goal in step 38; gymnax's stays for 12 steps, and is at the goal in step 49.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q gymnax==1.0.1 jax==0.10.2 flax==0.12.8 numpy==2.4.6 gymnasium==1.3.0 six==1.17.0
"$folder/bin/python" -W ignore - <<'END'
import gymnasium
import gymnax
import jax
import jax.numpy as jnp
import numpy as np

theirs = gymnasium.make("MountainCarContinuous-v0").unwrapped
theirs.reset(seed=0)
theirs.state = np.array([-1.0, -0.06], np.float32)
env, settings = gymnax.make("MountainCarContinuous-v0")
key = jax.random.PRNGKey(0)
state = env.reset(key, settings)[1].replace(position=jnp.array(-1.0), velocity=jnp.array(-0.06))
at_wall, at_goal = {"gymnasium": 0, "gymnax": 0}, {}
for step in range(1, 101):
    seen, _, ends, *_ = theirs.step(np.array([1.0], np.float32))
    final, state, _, ended, _, info = env.step(key, state, jnp.array([1.0]), settings)
    for name, place, is_end in (
        ("gymnasium", seen[0], ends),
        ("gymnax", info["final_observation"][0], ended),
    ):
        at_wall[name] += int(name not in at_goal and abs(place + 1.2) < 1e-6)
        if is_end:
            at_goal.setdefault(name, step)
print("steps at the wall:", at_wall, "first step at the goal:", at_goal)
assert at_wall == {"gymnasium": 1, "gymnax": 12}
assert at_goal == {"gymnasium": 38, "gymnax": 49}
END
