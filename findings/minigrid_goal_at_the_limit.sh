#!/usr/bin/env bash
# MiniGrid 3.2.0: an agent that reaches the goal on the last step is both terminated and truncated, with
# a reward of 0.1. Code that asks for `truncated` first bootstraps from the value of a solved episode.
# Seen: five steps to the goal with max_steps=5 end in (0.1, True, True); with 6 in (0.25, True, False).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q minigrid==3.2.0
"$folder/bin/python" -W ignore - <<'END'
import gymnasium
import minigrid  # noqa: F401


def last(max_steps):
    env = gymnasium.make("MiniGrid-Empty-5x5-v0", max_steps=max_steps)
    env.reset(seed=0)
    for action in (2, 2, 1, 2, 2):  # forward twice, right, forward twice
        _, reward, terminated, truncated, _ = env.step(action)
    return round(float(reward), 6), bool(terminated), bool(truncated)


print(last(5), last(6))
assert last(5) == (0.1, True, True) and last(6) == (0.25, True, False)
END
