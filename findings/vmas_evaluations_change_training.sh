#!/usr/bin/env bash
# VMAS 1.5.2: all environments of a process draw from one random stream, which each new one seeds anew. An evaluation
# between two episodes of training changes the later one, and an environment for evaluations with training's own
# seed takes training back to its beginning: it plays its first episodes again.
# Seen: the second reset of one seed differs once another environment was reset in between, and equals the first reset
# after another was made with the same seed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q vmas==1.5.2 torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import torch
import vmas


def make(seed):
    return vmas.make_env("simple_spread", num_envs=2, seed=seed, device="cpu")


def resets(between):
    """Returns the observations of two resets of one environment, and calls `between` in between."""
    env = make(0)
    first = torch.stack(env.reset())
    between()
    return first, torch.stack(env.reset())


first, alone = resets(lambda: None)
_, with_others = resets(lambda: make(1).reset())
_, with_a_twin = resets(lambda: make(0))
equal = torch.equal(alone, with_others), torch.equal(with_a_twin, first), torch.equal(alone, first)
print("as without another, with its twin as at first, without a twin as at first:", equal)
assert equal == (False, True, False)
END
