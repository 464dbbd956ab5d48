#!/usr/bin/env bash
# MuJoCo 4.0.0: after `mj_step` sensors, `xpos` and what `mj_ray` hits belong to the state before the step, `qpos` and
# `qvel` to the one after it. An observation of both mixes two times; at one step of 0.1 s per action a robot at
# 1 m/s is 10 cm nearer to the wall than its lidar says. `mj_forward` after the step makes them one.
# Seen: at x = 0.1, 0.2 and 0.3, of a wall at 2, the rangefinder and `mj_ray` read 2, 1.9 and 1.8.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q mujoco==4.0.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import mujoco
import numpy as np

model = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option gravity="0 0 0" timestep="0.1"/>
  <worldbody>
    <geom type="box" size="0.1 1 1" pos="2.1 0 0"/>
    <body>
      <joint type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.1" mass="1"/>
      <site name="lidar" zaxis="1 0 0"/>
    </body>
  </worldbody>
  <sensor><rangefinder site="lidar"/></sensor>
</mujoco>""")
data = mujoco.MjData(model)
data.qvel[0] = 1


def seen():
    ray = mujoco.mj_ray(model, data, data.site("lidar").xpos, np.array([1.0, 0, 0]), None, 1, 1, None)
    return [round(float(x), 6) for x in (data.qpos[0], data.xpos[1, 0], data.sensordata[0], ray)]


for step in range(1, 4):
    mujoco.mj_step(model, data)
    print("qpos, xpos, rangefinder, ray:", seen())
    assert seen() == [round(0.1 * step, 6), *(round(x, 6) for x in (0.1 * (step - 1), *[2.1 - 0.1 * step] * 2))]
mujoco.mj_forward(model, data)
print("after mj_forward:", seen())
assert seen() == [0.3, 0.3, 1.7, 1.7]
END
