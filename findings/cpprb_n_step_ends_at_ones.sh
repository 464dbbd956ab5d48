#!/usr/bin/env bash
# cpprb 11.0.0: with n-step returns, the next observation of an episode's last n - 1 steps is all ones, whatever it
# was. `on_episode_end` moves the waiting steps to the buffer with their rewards, and with a `next_obs` that was
# allocated as ones and never written. At a time limit `done` is 0, so that a learner bootstraps from that place, in
# n - 1 of the steps of every episode.
# By the definition of returns that an episode's end cuts short, those steps lead to its last observation.
# Seen: with 3-step returns along a path from (10, 20) to (15, 25), steps lead to 13, 14, 15, 1 and 1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q cpprb==11.0.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from cpprb import ReplayBuffer

keys = dict(obs=dict(shape=2), rew={}, next_obs=dict(shape=2), done={})
buffer = ReplayBuffer(100, keys, Nstep=dict(size=3, gamma=0.5, rew="rew", next="next_obs"))
path = np.array([(10 + t, 20 + t) for t in range(6)])
for here, there in zip(path, path[1:]):
    buffer.add(obs=here, rew=1, next_obs=there, done=0)
buffer.on_episode_end()
steps = {key: value.tolist() for key, value in buffer.get_all_transitions().items()}
print(steps)
by_hand = [path[min(t + 3, 5)].tolist() for t in range(5)]
assert steps["obs"] == path[:5].tolist() and steps["done"] == [[0]] * 5
assert steps["rew"] == [[1.75]] * 3 + [[1.5], [1]]
assert steps["next_obs"] == by_hand[:3] + [[1, 1]] * 2 and by_hand[3:] == [[15, 25]] * 2
END
