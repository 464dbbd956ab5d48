#!/usr/bin/env bash
# Minari 0.5.4: uint8 images of at least 32 x 32 that a dataset is made from are stored as JPEG unless
# create_dataset_from_buffers gets jpeg_encoding=False. What is read back is not what was written.
# Seen: noise of 64 x 64 comes back with pixels that are off by more than 100 of 255; with False it is equal.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "minari[hdf5]==0.5.4" gymnasium==1.4.0 numpy==2.2.6 pillow==12.0.0
MINARI_DATASETS_PATH="$folder/data" "$folder/venv/bin/python" -W ignore - <<'END'
import gymnasium as gym
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer

images = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)


def read_back(name, **options):
    buffer = EpisodeBuffer(
        id=0,
        observations=images,
        actions=np.zeros(2, np.int64),
        rewards=np.zeros(2),
        terminations=np.array([False, True]),
        truncations=np.zeros(2, bool),
        infos={},
    )
    space = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    minari.create_dataset_from_buffers(
        name, [buffer], observation_space=space, action_space=gym.spaces.Discrete(2), **options
    )
    return minari.load_dataset(name)[0].observations


off = np.abs(read_back("by/default-v0").astype(int) - images).max()
print("largest error by default:", off, "with jpeg_encoding=False:", np.abs(read_back("with/false-v0", jpeg_encoding=False).astype(int) - images).max())
assert off > 100
assert np.array_equal(read_back("with/false2-v0", jpeg_encoding=False), images)
END
