#!/usr/bin/env bash
# MinAtar 1.0.15: `reset` does not forget the last action, so that with sticky actions an episode may begin
# with the last action of the episode before. Episodes with the same seed differ by what was done before it.
# Seen: after `seed(s)` and `reset()`, the same first action moves the paddle left or not at all, depending
# on the last action before the reset, in 1 of about 10 seeds.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q minatar==1.0.15 matplotlib seaborn numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
from minatar import Environment


def position_after_one_step(last_action, seed):
    env = Environment("breakout")
    env.act(0)
    env.last_action = last_action  # 0 nothing, 1 left: what a former episode may have ended with
    env.seed(seed)
    env.reset()
    env.act(0)
    return env.env.pos


differ = [s for s in range(100) if position_after_one_step(0, s) != position_after_one_step(1, s)]
print(len(differ), "of 100 seeds differ")
assert 3 <= len(differ) <= 20
END
