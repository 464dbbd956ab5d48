#!/usr/bin/env bash
# scikit-fmm 2025.6.23: `distance` from a cell is right along rows and columns, but a fifth too long to the diagonal
# neighbour, and the error stays: 0.29 cells after 5, in a square without a wall. If the goal is marked by -1 instead
# of 0, as in its examples, distances are to the edge of its cell, some half a cell shorter, and at the goal below 0.
# Seen, marked by 0: 5 straight, 1.71 and 7.36 diagonally (true: 1.41, 7.07). By -1: -0.35 at the goal, 4.43, 6.86.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q scikit-fmm==2025.6.23 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
import skfmm


def distances(mark):
    square = np.ones((21, 21))
    square[10, 10] = mark
    found = skfmm.distance(square)
    cells = [(10, 10), (10, 15), (11, 11), (15, 15)]
    return [round(float(found[cell]), 2) for cell in cells]


print("here, 5 straight, 1 and 5 diagonally, marked by 0:", distances(0), "by -1:", distances(-1))
assert distances(0) == [0, 5, 1.71, 7.36]  # true: 0, 5, 1.41, 7.07
assert distances(-1) == [-0.35, 4.43, 1.21, 6.86]
END
