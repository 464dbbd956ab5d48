#!/usr/bin/env bash
# trimesh 5.2.0: `to_2D` of a section puts the middle of what was cut at (0, 0). So floor plans cut from a mesh at
# two heights do not lie above each other, and neither has the mesh's coordinates, though the plane is level.
# Giving it to_2D=numpy.eye(4) keeps them.
# Seen, a house whose upper floor is narrower: its west wall, at x = 10 on both floors, is at -5 below and at -2 above.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q trimesh==5.2.0 numpy==2.2.6 scipy==1.17.1 networkx==3.6.1 shapely==2.2.0
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
import trimesh

ground = trimesh.creation.box(bounds=[[10, 0, 0], [20, 6, 3]])
upper = trimesh.creation.box(bounds=[[10, 0, 3], [14, 6, 6]])


def west(floor, height, **settings):
    cut = floor.section(plane_origin=(0, 0, height), plane_normal=(0, 0, 1))
    return cut.to_2D(**settings)[0].bounds[0, 0].round(6).item()


walls = [west(ground, 1), west(upper, 4)]
print("x of the west wall in the mesh:", 10, "in the plans:", walls)
assert walls == [-5, -2]
kept = [west(ground, 1, to_2D=np.eye(4)), west(upper, 4, to_2D=np.eye(4))]
assert kept == [10, 10]
END
