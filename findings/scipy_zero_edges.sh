#!/usr/bin/env bash
# SciPy 1.17.1: an edge of length 0 is an edge in a sparse matrix and none in a dense one. The same
# graph, handed to `csgraph.shortest_path` as `matrix` and as `matrix.toarray()`, has other paths: two
# doors at the same place are joined, or unreachable.
# Seen: distances (0, 0, 1) from the sparse form, (0, inf, inf) from the dense one.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q scipy==1.17.1
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import shortest_path

graph = csr_matrix(([0.0, 1.0], ([0, 1], [1, 2])), shape=(3, 3))
sparse, dense = shortest_path(graph)[0], shortest_path(graph.toarray())[0]
print("sparse:", sparse, "dense:", dense)
assert sparse.tolist() == [0, 0, 1] and dense.tolist() == [0, np.inf, np.inf]
END
