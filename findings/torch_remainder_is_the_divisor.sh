#!/usr/bin/env bash
# PyTorch 2.13.0: `angle % (2 pi)` is not always below 2 pi. Of a negative angle nearer to 0 than 0.0000002 the
# remainder, in float32, is rounded up to the divisor. A heading that is just right of ahead is then in sector n
# of 0 to n - 1: an index that does not exist, or the first of the next agent in a flat table.
# Seen: of -1e-9 the remainder is 2 pi, and the sector of 8 is 8; Python's and NumPy's do so with -1e-17.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import math

import numpy as np
import torch

angle = torch.tensor(-1e-9)
wrapped = angle % (2 * math.pi)
sector = int(wrapped / (2 * math.pi) * 8)
print("wrapped:", wrapped.item(), "sector of 8:", sector)
assert wrapped == torch.tensor(2 * math.pi) and sector == 8
assert -1e-17 % (2 * math.pi) == np.mod(-1e-17, 2 * np.pi) == 2 * math.pi
END
