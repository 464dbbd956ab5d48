#!/usr/bin/env bash
# OpenCV 5.0.0: walls drawn with a thickness of 3 cells are 5 cells thick, and those of 2 are 3. `line`, `polylines`
# and `rectangle` draw 2 cells more than an odd thickness from 3 on, and 1 more than an even one, so that a
# corridor or a door between two such walls is up to 2 cells narrower than it was drawn.
# Seen: thicknesses of 1 to 6 are 1, 3, 5, 5, 7 and 7 cells, along either axis.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q opencv-python-headless==5.0.0.93 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import cv2
import numpy as np


def widths(start, end):
    """Returns the cells across the middle of a line, for thicknesses from 1 to 6."""
    across = (slice(None), 30) if start[1] == end[1] else 30
    pictures = [cv2.line(np.zeros((61, 61), np.uint8), start, end, 1, thickness) for thickness in range(1, 7)]
    return [int(picture[across].sum()) for picture in pictures]


level, upright = widths((15, 30), (45, 30)), widths((30, 15), (30, 45))
print("cells of thicknesses from 1 to 6:", level, upright)
assert level == upright == [1, 3, 5, 5, 7, 7]
END
