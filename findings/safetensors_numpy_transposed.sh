#!/usr/bin/env bash
# safetensors 0.8.0: `safetensors.numpy.save` writes a transposed array in the order of its memory under
# the shape of its view. It loads without a word, scrambled. `safetensors.torch.save` refuses the same.
# Seen: ((0, 3), (1, 4), (2, 5)) comes back as ((0, 1), (2, 3), (4, 5)).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q safetensors==0.8.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from safetensors.numpy import load, save

weights = np.arange(6, dtype=np.float32).reshape(2, 3).T
back = load(save({"weights": weights}))["weights"]
copied = load(save({"weights": np.ascontiguousarray(weights)}))["weights"]
print("saved:", weights.tolist(), "loaded:", back.tolist())
assert back.tolist() == [[0, 1], [2, 3], [4, 5]] and (copied == weights).all()
END
