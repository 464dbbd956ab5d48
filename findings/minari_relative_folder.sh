#!/usr/bin/env bash
# Minari 0.5.4: with a relative MINARI_DATASETS_PATH a dataset is read, but none can be made from buffers: the
# folder comes twice in the path of its file.
# Seen: create_dataset_from_buffers raises FileNotFoundError with "data" relative, and works with it absolute.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "minari[hdf5]==0.5.4" gymnasium==1.4.0 numpy==2.2.6 pillow==12.0.0
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'END'
import os

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer


def make(path):
    os.environ["MINARI_DATASETS_PATH"] = path
    ends = np.array([False, True])
    buffer = EpisodeBuffer(0, None, None, np.zeros((3, 1), np.float32), np.zeros(2, np.int64), np.zeros(2), ends, ~ends, {})
    spaces = dict(observation_space=gym.spaces.Box(0, 1, (1,)), action_space=gym.spaces.Discrete(2))
    try:
        return minari.create_dataset_from_buffers("one/two-v0", [buffer], **spaces).total_episodes
    except FileNotFoundError as error:
        return type(error).__name__


seen = make("data"), make(os.path.abspath("other"))
print("relative, absolute:", seen)
assert seen == ("FileNotFoundError", 1)
END
