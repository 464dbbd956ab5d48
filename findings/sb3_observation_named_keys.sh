#!/usr/bin/env bash
# Stable-Baselines3 2.9.2: a dictionary of observations with an entry named `keys` cannot be trained. Entries
# become names of modules in a torch ModuleDict, which has a method of that name; `items`, `values`, `pop`,
# `type` and `training` are taken, too.
# Seen: KeyError "attribute 'keys' already exists".
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q stable-baselines3==2.9.2 torch==2.13.0
"$folder/bin/python" -W ignore - <<'END'
import gymnasium
import numpy as np
import stable_baselines3
from gymnasium.spaces import Box, Dict, Discrete


def error_of(name):
    class Env(gymnasium.Env):
        observation_space = Dict({name: Box(0, 1, (2,))})
        action_space = Discrete(2)

        def reset(self, seed=None, options=None):
            return {name: np.zeros(2, np.float32)}, {}

        def step(self, action):
            return {name: np.zeros(2, np.float32)}, 0.0, False, False, {}

    try:
        stable_baselines3.PPO("MultiInputPolicy", Env())
    except KeyError as error:
        return str(error)
    return None


print(error_of("keys"), error_of("training"), error_of("image"))
assert "already exists" in error_of("keys") and "already exists" in error_of("training")
assert error_of("door") is None
END
