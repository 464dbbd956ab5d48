#!/usr/bin/env bash
# MiniGrid 3.2.0: the "fully observable" view shows less than the partial one: FullyObsWrapper and
# SymbolicObsWrapper do not show what the agent carries, while the agent's own view draws it in the
# agent's cell. In DoorKey a policy on the full view cannot know whether it has the key.
# Seen: with and without a key in hand the full and symbolic views are equal, the partial view is not.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q minigrid==3.2.0
"$folder/bin/python" -W ignore - <<'END'
import gymnasium
import minigrid  # noqa: F401
from minigrid.core.world_object import Key
from minigrid.wrappers import FullyObsWrapper, SymbolicObsWrapper

env = gymnasium.make("MiniGrid-Empty-5x5-v0")
env.reset(seed=0)
inner, full, symbolic = env.unwrapped, FullyObsWrapper(env), SymbolicObsWrapper(env)


def views(carried):
    inner.carrying = carried
    partial = inner.gen_obs()
    return [
        partial["image"],
        full.observation(inner.gen_obs())["image"],
        symbolic.observation(inner.gen_obs())["image"],
    ]


same = [bool((a == b).all()) for a, b in zip(views(None), views(Key("yellow")))]
print("partial, full, symbolic are the same with a key in hand:", same)
assert same == [False, True, True]
END
