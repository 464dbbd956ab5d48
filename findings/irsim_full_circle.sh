#!/usr/bin/env bash
# IR-SIM 2.12.0: a lidar of a full circle has its rear beam twice, so that its beams are further apart
# than 360 degrees by their number. `number: 4` gives three directions, 120 degrees apart.
# A policy that was trained with n beams at 360/n degrees gets other directions.
# Seen: angles -180, -60, 60, 180 degrees.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q ir-sim==2.12.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from irsim.world.sensors.lidar2d import Lidar2D

lidar = Lidar2D(state=np.zeros((3, 1)), angle_range=2 * np.pi, number=4)
angles = np.degrees(lidar.angle_list)
print("angles:", angles)
assert np.allclose(angles, [-180, -60, 60, 180])
END
