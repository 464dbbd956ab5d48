#!/usr/bin/env bash
# MinAtar 1.0.15, Seaquest: bringing up six divers leaves -1 on board, not 0, as one is counted off after the
# count was cleared. From then on surfacing without a diver, which ends the game otherwise, only counts one
# more off and gives full oxygen, for as long as the agent likes.
# Seen: after six divers, the count is -1; surfacing 20 more times without a diver does not end the game.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q --no-deps minatar==1.0.15 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import logging

logging.disable(logging.WARNING)  # that it cannot draw
from minatar import Environment

DOWN, UP = 4, 2


def surface(divers, times):
    """Dives by a row and comes up again, with no enemy there. Returns divers on board and the end."""
    env = Environment("seaquest", sticky_action_prob=0.0)
    env.reset()
    env.env.diver_count = divers
    done = False
    for _ in range(times):
        for action in DOWN, UP:
            env.env.e_subs, env.env.e_fish, env.env.e_bullets = [], [], []
            done = done or env.act(action)[1]
    return env.env.diver_count, done


print("divers, ended: with none", surface(0, 1), "with six", surface(6, 1), "then 20 more", surface(6, 21))
assert surface(0, 1) == (0, True)
assert surface(6, 1) == (-1, False)
assert surface(6, 21) == (-21, False)
END
