#!/usr/bin/env bash
# SciPy 1.17.1: `distance_transform_edt` of a map without a wall is neither infinite nor an error: it
# measures to a cell that does not exist, above the first corner. A clearance map of an open field says
# that its corner is 1 cell from a wall.
# Seen: ones of shape (2, 3) give ((1, 1.41, 2.24), (2, 2.24, 2.83)).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q scipy==1.17.1
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from scipy.ndimage import distance_transform_edt

clearance = distance_transform_edt(np.ones((2, 3)))
print(clearance)
assert np.allclose(clearance, np.sqrt([[1, 2, 5], [4, 5, 8]]))
END
