#!/usr/bin/env bash
# Gymnasium 1.4.0: "CartPole-v1" made by `make_vec` in its two modes starts other episodes from the same seed.
# The vectorised form fills one array for all copies from one generator, the synchronous one seeds copy i
# with seed + i: not even the first copy agrees, in its second number.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q gymnasium==1.4.0
"$folder/bin/python" -W ignore - <<'END'
import gymnasium


def starts(mode, seed):
    env = gymnasium.make_vec("CartPole-v1", num_envs=2, vectorization_mode=mode)
    return env.reset(seed=seed)[0]


sync, vector = starts("sync", 0), starts("vector_entry_point", 0)
print(sync[0], vector[0])
assert (sync[0] == starts("sync", 0)[0]).all() and sync[0, 0] == vector[0, 0]
assert not (sync[0, 1:] == vector[0, 1:]).any()
assert (sync[1] == starts("sync", 1)[0]).all()
END
