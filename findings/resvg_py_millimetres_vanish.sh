#!/usr/bin/env bash
# resvg_py 0.5.0: lengths in mm, cm, in and pt are 0, as its default of `dpi` is 0. Strokes of 2mm and shapes
# of millimetres are not painted, in a picture without an error; those in pixels are. `dpi=96` paints them.
# Seen: a wall of 100 x 10 pixels has 1000 painted pixels as a stroke of 10, and none as one of 2.6458mm.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q resvg_py==0.5.0 pillow==12.0.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import io

import numpy as np
import resvg_py
from PIL import Image


def painted(width, **options):
    text = f'<svg xmlns="http://www.w3.org/2000/svg" width="200" height="50"><path d="M50 25h100" stroke="#000" stroke-width="{width}"/></svg>'
    picture = resvg_py.svg_to_bytes(svg_string=text, **options)
    return int((np.asarray(Image.open(io.BytesIO(bytes(picture))))[..., 3] > 127).sum())


pixels, metric, with_dpi = painted("10"), painted("2.6458mm"), painted("2.6458mm", dpi=96)
print("stroke of 10:", pixels, "of 2.6458mm:", metric, "with dpi=96:", with_dpi)
assert (pixels, metric, with_dpi) == (1000, 0, 1000)
END
