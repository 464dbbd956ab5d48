#!/usr/bin/env bash
# MiniGrid 3.2.0: MiniGrid-MultiRoom-N4-S5-v0, whose name says four rooms, always has six. -v1 has four.
# Seen: rooms in 100 seeds are {6} in v0 and {4} in v1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q minigrid==3.2.0 gymnasium==1.4.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import gymnasium as gym
import minigrid  # noqa: F401


def rooms(name):
    env = gym.make(name).unwrapped
    return {len(env.rooms) for seed in range(100) if env.reset(seed=seed)}


print("v0:", rooms("MiniGrid-MultiRoom-N4-S5-v0"), "v1:", rooms("MiniGrid-MultiRoom-N4-S5-v1"))
assert rooms("MiniGrid-MultiRoom-N4-S5-v0") == {6}
assert rooms("MiniGrid-MultiRoom-N4-S5-v1") == {4}
END
