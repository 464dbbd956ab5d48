#!/usr/bin/env bash
# ImageIO 2.38.1 with imageio-ffmpeg: an mp4 of 150 x 100 pixels is written as 160 x 112. Sizes are
# rounded up to multiples of 16 by resampling each frame (a log line says so), so pixel-exact
# observations in a film are blurred; `macro_block_size=1` keeps them.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q imageio[ffmpeg]==2.38.1 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import tempfile

import imageio.v2 as imageio
import numpy as np


def size(**options):
    path = tempfile.mktemp(suffix=".mp4")
    with imageio.get_writer(path, fps=30, **options) as writer:
        for value in range(5):
            writer.append_data(np.full((100, 150, 3), 40 * value, np.uint8))
    return imageio.get_reader(path).get_data(0).shape[1::-1]


default, exact = size(), size(macro_block_size=1)
print("width, height:", default, exact)
assert default == (160, 112) and exact == (150, 100)
END
