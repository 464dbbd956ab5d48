#!/usr/bin/env bash
# MuJoCo 4.0.0: a plane with a size is infinite for contacts but ends at its drawn edge for rays.
# Bodies 3 m from the centre of a plane of 1 m come to rest on it, while a rangefinder that looks down
# from the same place sees nothing. A lidar over such a floor reads "no hit" where a robot can stand.
# Seen: resting height 0.1, rangefinder -1; above the drawn part the rangefinder reads 0.5.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q mujoco==4.0.0
"$folder/bin/python" -W ignore - <<'END'
import mujoco

XML = """<mujoco><worldbody>
<geom type="plane" size="1 1 .1"/>
<body pos="{x} 0 .5"><freejoint/><geom size=".1" mass="1"/><site name="s" zaxis="0 0 -1"/></body>
</worldbody><sensor><rangefinder site="s"/></sensor></mujoco>"""


def look_and_fall(x):
    model = mujoco.MjModel.from_xml_string(XML.format(x=x))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    distance = float(data.sensordata[0])
    for _ in range(2000):
        mujoco.mj_step(model, data)
    return distance, float(data.qpos[2])


inside, outside = look_and_fall(0), look_and_fall(3)
print("distance, resting height:", inside, outside)
assert abs(inside[0] - 0.5) < 1e-6 and abs(inside[1] - 0.1) < 0.01
assert outside[0] == -1 and abs(outside[1] - 0.1) < 0.01
END
