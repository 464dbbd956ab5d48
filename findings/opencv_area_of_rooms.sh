#!/usr/bin/env bash
# OpenCV 5.0.0: the contour of a room of 10 x 10 cells has an area of 81, as it passes through the centres of its
# outer cells, and a polygon of 10 x 10 fills 121. Rooms of a map are short by half a cell all around, at 5 cm a
# cell 8 % of a bathroom of 1 x 1.5 m, and a corridor of one cell has no area.
# Seen: 81 and a length of 36 of 100 cells, 0 of a corridor of 1 x 10; fillPoly from (0, 0) to (10, 10) fills 121.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q opencv-python-headless==5.0.0.93 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import cv2
import numpy as np


def area(height, width):
    cells = np.zeros((20, 20), np.uint8)
    cells[5 : 5 + height, 5 : 5 + width] = 1
    (contour,), _ = cv2.findContours(cells, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return cv2.contourArea(contour)


square = np.array([(0, 0), (10, 0), (10, 10), (0, 10)], np.int32)
filled = cv2.fillPoly(np.zeros((20, 20), np.uint8), [square], 1).sum()
print("areas of 100 and of 10 cells:", area(10, 10), area(1, 10), "of a polygon of 100, filled:", filled)
assert (area(10, 10), area(1, 10), filled) == (81, 0, 121)
END
