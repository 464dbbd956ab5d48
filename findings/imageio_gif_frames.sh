#!/usr/bin/env bash
# ImageIO 2.38.1 with Pillow: the film of an agent that waits has fewer frames than were written, and 60
# frames a second are played at 100. Equal neighbours are merged into one frame; GIF counts hundredths
# of a second and the rest is cut off.
# Seen: ten equal frames are one of 200 ms; a duration of 16.7 ms is stored as 10 ms.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q imageio==2.38.1 pillow==13.0.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import io

import imageio.v2 as imageio
import numpy as np
from PIL import Image


def stored(values, duration):
    file = io.BytesIO()
    frames = [np.full((8, 8, 3), value, np.uint8) for value in values]
    imageio.mimsave(file, frames, format="gif", duration=duration)
    picture = Image.open(io.BytesIO(file.getvalue()))
    return picture.n_frames, picture.info["duration"]


still, fast = stored([7] * 10, 20), stored(range(0, 200, 20), 1000 / 60)
print("frames, ms:", still, fast)
assert still == (1, 200) and fast == (10, 10)
END
