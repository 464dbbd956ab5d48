#!/usr/bin/env bash
# OpenCV 5.0.0: `distanceTransform` with `DIST_L2` and the mask 3 says that a wall ten cells ahead is 9.55 cells away.
# The mask's step along an axis counts 0.955, that of a diagonal 1.369: clearances are 4.5 % short where walls are
# straight, which is nearly everywhere in a home. The masks 5 and 0 (`DIST_MASK_PRECISE`) have 10.
# Seen: ten cells along an axis are 9.55, 10 and 10; along the diagonal, 14.142, they are 13.693, 14 and 14.142.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q opencv-python-headless==5.0.0.93 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import cv2
import numpy as np

floor = np.ones((11, 11), np.uint8)
floor[0, 0] = 0  # a wall
found = [cv2.distanceTransform(floor, cv2.DIST_L2, mask) for mask in (3, 5, cv2.DIST_MASK_PRECISE)]
straight, diagonal = ([round(float(far[y, 10]), 3) for far in found] for y in (0, 10))
print("ten cells along an axis:", straight, "along the diagonal:", diagonal)
assert straight == [9.55, 10, 10] and diagonal == [13.693, 14, 14.142]
END
