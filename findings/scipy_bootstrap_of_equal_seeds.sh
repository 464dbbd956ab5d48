#!/usr/bin/env bash
# SciPy 1.17.1: the default bootstrap interval (BCa) of seeds that all reached the same success rate is
# (nan, nan), with a warning; `method="percentile"` gives (1, 1). A table of intervals gets holes where the
# results are best.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q scipy==1.17.1
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from scipy.stats import bootstrap

success = (np.ones(5),)
default = bootstrap(success, np.mean, rng=0).confidence_interval
percentile = bootstrap(success, np.mean, method="percentile", rng=0).confidence_interval
print("BCa:", default, "percentile:", percentile)
assert np.isnan([default.low, default.high]).all()
assert (percentile.low, percentile.high) == (1, 1)
END
