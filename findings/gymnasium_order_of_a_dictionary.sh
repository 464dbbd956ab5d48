#!/usr/bin/env bash
# Gymnasium 1.4.0: `Dict({"wall": a, "goal": b})` and `Dict(wall=a, goal=b)` are other vectors. The first sorts its
# keys, the second keeps them, and `flatten` and FlattenObservation go by that order. The two are equal by `==`,
# so that an agent is loaded into an environment that was written the other way, and takes walls for goals.
# Seen: a wall of 1 and a goal of 2 are flattened to (2, 1) and (1, 2).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q gymnasium==1.4.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
from gymnasium.spaces import Box, Dict, flatten

parts = {"wall": Box(0, 9, (1,)), "goal": Box(0, 9, (1,))}
value = {"wall": [1.0], "goal": [2.0]}
braces, keywords = Dict(parts), Dict(**parts)
vectors = [flatten(space, value).tolist() for space in (braces, keywords)]
print("from braces and from keywords:", vectors, "equal:", braces == keywords)
assert vectors == [[2, 1], [1, 2]] and braces == keywords
END
