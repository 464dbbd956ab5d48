#!/usr/bin/env bash
# Matplotlib 3.11.2: whether a point is in a room depends on the direction in which its corners are listed.
# `Path.contains_point(point, radius=r)` makes a polygon larger by r if it runs counterclockwise, and smaller if it
# runs clockwise; points on a wall are inside the first, outside the second. Masks of rooms differ by a margin.
# Seen, a room of 4 x 4, r = 0.2: points at 3.95 and 4.05 are both in it, or neither is.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q matplotlib==3.11.2 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
from matplotlib.path import Path

room = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0)]


def inside(corners, **margin):
    return [bool(Path(corners).contains_point((x, 2), **margin)) for x in (3.95, 4, 4.05)]


seen = [inside(corners, **margin) for margin in ({"radius": 0.2}, {}) for corners in (room, room[::-1])]
print("counterclockwise and clockwise, with a radius:", *seen[:2], "without:", *seen[2:])
assert seen == [[True] * 3, [False] * 3, [True, True, False], [True, False, False]]
END
