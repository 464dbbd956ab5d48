#!/usr/bin/env bash
# pyastar2d 1.1.4: with allow_diagonal=True a diagonal step costs as much as a straight one, so what it finds is a
# path of the fewest steps, not the shortest one, and it need not be straight where nothing is in the way. As the
# shortest path of SPL it is up to 41 % too long, so an agent that zigzags as much has an SPL of 1.
# Seen, along a row of an empty room, 10 cells away: it leaves the row twice, and is 11.66 cells long.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q pyastar2d==1.1.4 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
import pyastar2d

room = np.ones((11, 11), np.float32)
path = pyastar2d.astar_path(room, (0, 0), (0, 10), allow_diagonal=True)
length = np.hypot(*np.diff(path, axis=0).T).sum()
print("rows on the way:", path[:, 0].tolist(), "length:", length.round(2), "straight: 10")
assert path[:, 0].any() and round(length, 2) == 11.66
assert len(pyastar2d.astar_path(room, (0, 0), (0, 10))) == 11  # straight, without diagonals
END
