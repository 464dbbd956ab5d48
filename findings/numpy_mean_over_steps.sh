#!/usr/bin/env bash
# NumPy 2.2.6: the mean of many float32 rows is wrong along the rows, and right along the flat array. Sums along the
# last axis are pairwise, those along others go one by one, and grow no more where the next number is rounded
# away. Statistics of observations (steps, features) of 20 million steps are 5 % off; counts end at 16,777,216.
# PyTorch sums both pairwise. `dtype=float` is right, too.
# Seen, 20 million rows of 0.1: means of 0.1049 of each column, 0.1 of all; as many ones have a sum of 16,777,216.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np

rows = np.full((20_000_000, 2), 0.1, np.float32)
columns, flat, wide = rows.mean(0), rows.ravel().mean(), rows.mean(0, dtype=float)
rows[:] = 1
count = rows.sum(0)[0]
print("means of columns:", columns, "of all:", flat, "in float64:", wide, "sum of ones:", count)
assert columns.round(4).tolist() == [np.float32(0.1049)] * 2
assert abs(flat - 0.1) < 1e-4 and abs(wide - 0.1).max() < 1e-6 and count == 2**24
END
