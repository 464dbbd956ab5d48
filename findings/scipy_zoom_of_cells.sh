#!/usr/bin/env bash
# SciPy 1.17.1: `ndimage.zoom` with `order=0` does not repeat cells. Centres of the first and last cell go to the
# first and last one of the result, so that a map that is enlarged has borders thinner than its inner walls,
# and none of these where it was. `grid_mode=True, mode="nearest"` repeats, as np.kron does.
# Seen, four times as large: three cells become 3, 6 and 3 cells, not 4, 4 and 4.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q scipy==1.17.1
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from scipy.ndimage import zoom

cells = np.array([1, 2, 3])
default = np.bincount(zoom(cells, 4, order=0))[1:].tolist()
repeated = np.bincount(zoom(cells, 4, order=0, grid_mode=True, mode="nearest"))[1:].tolist()
print("widths:", default, "with grid_mode:", repeated)
assert default == [3, 6, 3] and repeated == [4, 4, 4]
END
