#!/usr/bin/env bash
# scikit-image 0.26.0: the shortest paths of `graph.route_through_array` and MCP_Geometric slip between cells that
# touch at a corner. A slanted wall of one cell, which stops every agent with a width, is no wall; and nothing
# is said of it. `fully_connected=False` goes along the axes alone, and there is no path then.
# Seen, on 7 x 7 cells with the diagonal from corner to corner closed: a path of 9.07 cells through it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q scikit-image==0.26.0
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from skimage.graph import route_through_array

costs = np.ones((7, 7))
costs[np.arange(7), 6 - np.arange(7)] = -1  # a cost below 0 is closed
path, length = route_through_array(costs, (0, 0), (6, 6))
try:
    route_through_array(costs, (0, 0), (6, 6), fully_connected=False)
    along_axes = "a path"
except ValueError:
    along_axes = "no path"
print("length:", length, "along the axes:", along_axes)
assert abs(length - 9.071) < 0.001  # two straight and five slanted steps
assert all(costs[cell] > 0 for cell in path) and along_axes == "no path"
END
