#!/usr/bin/env bash
# MuJoCo 4.0.0: what a rangefinder sees is decided by paint, not by collisions.
# A solid wall with alpha 0 stops bodies but no ray; a ghost (contype 0) stops rays but no body. A
# sensor on a child link sees its own robot, as only geoms of the sensor's own body are left out.
# A hit beyond `cutoff` reads as the cutoff, no hit at all as -1, so the nearest reading may be "none".
# Seen: -1 through the invisible wall, 0.9 to the ghost, 0.1 to the own hull, 2 and -1 with a cutoff of 2.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q mujoco==4.0.0
"$folder/bin/python" -W ignore - <<'END'
import mujoco

WALL = '<geom type="box" size=".1 1 1" pos="{x} 0 .5" {more}/>'


def read(world, robot='<site name="s" zaxis="1 0 0"/>', cutoff=0):
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>{world}
    <body pos="0 0 .5"><freejoint/><geom size=".1" mass="1"/>{robot}</body></worldbody>
    <sensor><rangefinder site="s" cutoff="{cutoff}"/></sensor></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return round(float(data.sensordata[0]), 6)


glass = read(WALL.format(x=2, more='rgba="1 1 1 0"'))
ghost = read(WALL.format(x=1, more='contype="0" conaffinity="0"'))
hull = read(WALL.format(x=2, more=""), '<body><site name="s" zaxis="1 0 0"/></body>')
far = read(WALL.format(x=5, more=""), cutoff=2)
nothing = read("", cutoff=2)
print(dict(glass=glass, ghost=ghost, hull=hull, far=far, nothing=nothing))
assert (glass, ghost, hull, far, nothing) == (-1, 0.9, 0.1, 2, -1)
END
