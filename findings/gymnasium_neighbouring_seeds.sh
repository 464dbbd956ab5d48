#!/usr/bin/env bash
# Gymnasium 1.4.0: runs with the seeds 0 and 1 play nearly the same episodes. A vector of n environments gives copy i
# the seed s + i, so that n - 1 of n copies begin alike, one place further on: five seeds of 64 copies are 68
# copies, of 320. Their spread is not that of independent runs. Seeds that are n apart share none.
# Seen, eight CartPoles: the last seven first observations of seed 0 are the first seven of seed 1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q gymnasium==1.4.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import gymnasium

envs = gymnasium.make_vec("CartPole-v1", 8, vectorization_mode="sync")
one, next_one, apart = (envs.reset(seed=seed)[0] for seed in (0, 1, 8))
shared = sum(row.tolist() in one.tolist() for row in next_one)
print("first observations that seeds 0 and 1 share:", shared, "of 8")
assert (one[1:] == next_one[:-1]).all() and shared == 7
assert not any(row.tolist() in one.tolist() for row in apart)
END
