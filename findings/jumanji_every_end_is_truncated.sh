#!/usr/bin/env bash
# Jumanji 1.1.2: JumanjiToGymWrapper calls each end of an episode truncated, deaths and solved tasks included, which
# are terminated as well. A learner that asks for `truncated` first, or alone, bootstraps from the value of a dead
# snake. Only a true time limit is truncated and not terminated.
# Seen: a snake that leaves the board ends with (terminated, truncated) = (True, True).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q jumanji==1.1.2 jax==0.10.2
"$folder/bin/python" -W ignore - <<'END'
import jumanji
from jumanji.wrappers import JumanjiToGymWrapper

env = JumanjiToGymWrapper(jumanji.make("Snake-v1"))
env.reset(seed=0)
for step in range(1, 100):
    _, _, terminated, truncated, _ = env.step(0)  # up, until it leaves the board
    if terminated or truncated:
        break
print("dead after", step, "steps: terminated", terminated, "truncated", truncated)
assert step < 15 and terminated and truncated
END
