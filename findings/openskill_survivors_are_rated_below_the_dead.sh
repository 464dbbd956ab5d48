#!/usr/bin/env bash
# openskill 6.2.0: in games of many players, those who share first place gain less than those who come after them.
# The Plackett-Luce model divides what a place earns by the number who share it: where 8 of 16 survive to the time
# limit, each earns (1 - 8/16) / 8 = 1/16, and the first to fall behind them 1 - 1/8 - 1/16 = 13/16, 13 times as much.
# It does not wash out: of those who lose to all survivors in each of 40 games, half are rated above them. By
# BradleyTerryFull of the same package, ratings of the same games have the order of the places.
# Seen, of a survivor and of who comes next: 25.1 and 26.5 after a game, 29.9 and 72.3 after 40; Bradley-Terry's
# are 46.8 and 26.5.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q openskill==6.2.0
"$folder/bin/python" -W ignore - <<'END'
from openskill.models import BradleyTerryFull, PlackettLuce

PLACES = [1] * 8 + [*range(9, 17)]


def means_after(n_games, model):
    players = [[model.rating()] for _ in PLACES]
    for _ in range(n_games):
        players = model.rate(players, ranks=PLACES)
    return [player.mu for (player,) in players]


once, often = means_after(1, PlackettLuce()), means_after(40, PlackettLuce())
other = means_after(40, BradleyTerryFull())
for means in (once, often, other):
    print("a survivor:", round(means[0], 1), "the others:", [round(mean, 1) for mean in means[8:]])
assert abs((once[8] - 25) / (once[0] - 25) - 13) < 1e-6
assert sum(mean > often[0] + 2 for mean in often[8:]) == 4 and other == sorted(other, reverse=True)
END
