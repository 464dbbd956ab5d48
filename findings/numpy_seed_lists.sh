#!/usr/bin/env bash
# NumPy 2.2.6: zeros at the end of a list of seeds count for nothing, so that `default_rng([seed, 0])` is
# `default_rng(seed)`. With [seed, environment, episode] the first environment's first episode draws what a policy
# draws that has the seed alone, and with [environment, seed] and seed 0 environment 5 is what a run of seed 5 draws.
# Up to four words are filled with zeros; those of numbers from 2**32 on are just strung together.
# `SeedSequence(seed, spawn_key=(0, 0))` and `spawn` are other streams.
# Seen: 7, [7, 0] and [7, 0, 0] draw 0.625; [7, 3] and 7 + 3 * 2**32 draw 0.975.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np


def first(*seed, **settings):
    return np.random.default_rng(np.random.SeedSequence(*seed, **settings)).random(1).round(3).item()


zeros = [first(7), first([7, 0]), first([7, 0, 0]), first([7, 0, 0, 0])]
large = [first([7, 3]), first(7 + 3 * 2**32)]
others = [first([7, 0, 0, 0, 0]), first([0, 7]), first(7, spawn_key=(0, 0))]
print("7 and zeros:", zeros, "7, 3 and 7 + 3 * 2**32:", large, "other streams:", others)
assert zeros == [0.625] * 4 and large == [0.975] * 2
assert np.random.default_rng([7, 0]).random(1000).tolist() == np.random.default_rng(7).random(1000).tolist()
assert len({0.625, *others}) == 4
END
