#!/usr/bin/env bash
# Pillow 13.0.0: a grey picture of 16 bits converted to 8 bits is clipped, not scaled. A floor plan or
# depth map with values up to 65,535 turns white nearly everywhere.
# Seen: 0, 255, 256, 32768, 65535 become 0, 255, 255, 255, 255.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q pillow==13.0.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from PIL import Image

picture = Image.fromarray(np.array([[0, 255, 256, 32768, 65535]], np.uint16))
grey = np.array(picture.convert("L")).tolist()
print(picture.mode, grey)
assert grey == [[0, 255, 255, 255, 255]]
END
