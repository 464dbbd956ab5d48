#!/usr/bin/env bash
# MuJoCo 4.0.0: a room that is one mesh is a solid block to bodies, and a room to rays. Contacts are with the convex
# hull of a mesh, rangefinders see its triangles. A robot that has 1.8 m of free floor all around by its lidar is pushed
# out through the roof; a wall with a door in it has none. Each wall as a geom of its own is right for both.
# Seen: a ball in the middle of an empty room of 4 m reads 1.8 m, and overlaps the room by 0.6; after two seconds
# without gravity it is 22 m higher.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q mujoco==4.0.0
"$folder/bin/python" -W ignore - <<'END'
import mujoco

points, faces = [], []
for x0, y0, x1, y1 in ((-2, -2, -1.8, 2), (1.8, -2, 2, 2), (-2, -2, 2, -1.8), (-2, 1.8, 2, 2)):  # four walls
    quads = (0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)
    for a, b, c, d in quads:
        faces += [len(points) + i for i in (a, b, c, a, c, d)]
    points += [(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (0, 1)]
model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <option gravity="0 0 0"/>
  <asset>
    <mesh name="room" inertia="shell" vertex="{" ".join(str(x) for p in points for x in p)}"
          face="{" ".join(map(str, faces))}"/>
  </asset>
  <worldbody>
    <geom type="mesh" mesh="room"/>
    <body pos="0 0 0.5">
      <freejoint/>
      <geom type="sphere" size="0.1" mass="1"/>
      <site name="lidar" zaxis="1 0 0"/>
    </body>
  </worldbody>
  <sensor><rangefinder site="lidar"/></sensor>
</mujoco>""")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
reading, overlap = round(data.sensordata[0], 3), [round(-contact.dist, 2) for contact in data.contact]
print("lidar:", reading, "m; overlap with the room:", overlap)
for _ in range(1000):
    mujoco.mj_step(model, data)
print("height after two seconds:", data.qpos[2])
assert reading == 1.8 and overlap == [0.6] and data.qpos[2] > 1.5
END
