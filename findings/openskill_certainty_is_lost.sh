#!/usr/bin/env bash
# openskill 6.2.0: a player who wins a game that was never in doubt becomes less certain: `tau` is added
# before the update, and such a game takes nothing off. Many easy duels make a rating's sigma grow, unless
# `limit_sigma=True`.
# Seen: sigma 1 of mu 50 after 100 wins over mu 0 is 1.3; with limit_sigma it stays 1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q openskill==6.2.0
"$folder/bin/python" -W ignore - <<'END'
from openskill.models import PlackettLuce


def sigma_after_easy_wins(**options):
    model = PlackettLuce(**options)
    strong = model.rating(mu=50, sigma=1)
    for _ in range(100):
        weak = model.rating(mu=0, sigma=1)
        (strong,), _ = model.rate([[strong], [weak]], ranks=[0, 1])
    return strong.sigma


grown, limited = sigma_after_easy_wins(), sigma_after_easy_wins(limit_sigma=True)
print(grown, limited)
assert 1.2 < grown < 1.4 and abs(limited - 1) < 1e-6
END
