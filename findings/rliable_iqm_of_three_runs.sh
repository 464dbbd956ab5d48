#!/usr/bin/env bash
# rliable 1.2.0: the interquartile mean of three runs is their mean: a quarter of three is rounded down to none,
# so that a failed seed counts in full, and of seven runs five are averaged. Only multiples of four runs times
# tasks have the robustness that the name promises.
# Seen, one failure among perfect runs: 0.667 of 3, 1 of 4; with two failures 0.8 of 7 and 1 of 8.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q scipy==1.17.1
"$folder/bin/pip" install -q --no-deps rliable==1.2.0
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
from rliable import metrics


def iqm(n, n_failed):
    """Of runs of one task."""
    return round(float(metrics.aggregate_iqm(np.r_[np.zeros(n_failed), np.ones(n - n_failed)][:, None])), 3)


seen = iqm(3, 1), iqm(4, 1), iqm(7, 2), iqm(8, 2)
print("IQM of 3, 4, 7 and 8 runs:", seen)
assert seen == (0.667, 1, 0.8, 1)
END
