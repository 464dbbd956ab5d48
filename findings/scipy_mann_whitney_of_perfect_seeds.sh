#!/usr/bin/env bash
# SciPy 1.17.1: three seeds that all reach 1 beat three that all reach 0 with p = 0.047; with any spread among them
# p = 0.1, the least that six numbers allow. `mannwhitneyu` is exact for few numbers, but where any two are equal it
# takes the normal approximation instead. Success rates, which tie at their ends, become significant that way.
# Seen: p of 0.047 and, of 1, 0.99 and 0.98 against 0, 0.01 and 0.02, of 0.1. Four against four: 0.013 and 0.029.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q scipy==1.17.1 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
from scipy import stats


def p_of(*samples):
    return round(float(stats.mannwhitneyu(*samples).pvalue), 3)


ties = p_of([1] * 3, [0] * 3), p_of([1] * 4, [0] * 4)
spread = p_of([1, 0.99, 0.98], [0, 0.01, 0.02]), p_of([1, 0.99, 0.98, 0.97], [0, 0.01, 0.02, 0.03])
print("p of three and of four, equal:", ties, "with a spread:", spread)
assert ties == (0.047, 0.013) and spread == (0.1, 0.029)
assert stats.mannwhitneyu([1] * 3, [0] * 3, method="exact").pvalue == 0.1
END
