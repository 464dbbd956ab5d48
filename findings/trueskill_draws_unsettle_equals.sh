#!/usr/bin/env bash
# trueskill 0.4.5: with draw_probability=0, for games that always have a winner, a draw of two equals, as when a time
# limit ends a duel after all, makes both less certain than they were, and the next one again. Its formula has a
# margin of 2e-7 then, and divides by a rounding error below 0. Draws of unequal players are rated well, all with 0.0001.
# By hand: both of N(25, 8.333^2 + 0.083^2) were equally good within noise of 4.167, so that the variance v becomes
# v (1 - v / (2 v + 2 * 4.167^2)), and sigma 6.455. Seen: 9.59, 10.84, 12.09, 13.33 after four draws.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q trueskill==0.4.5
"$folder/bin/python" -W ignore - <<'END'
import math

import trueskill


def sigmas(draw_probability, n):
    rules = trueskill.TrueSkill(draw_probability=draw_probability)
    a, b, values = rules.create_rating(), rules.create_rating(), []
    for _ in range(n):
        a, b = rules.rate_1vs1(a, b, drawn=True)
        values.append(round(a.sigma, 2))
    return values


v = (25 / 3) ** 2 + (25 / 300) ** 2
by_hand = math.sqrt(v * (1 - v / (2 * v + 2 * (25 / 6) ** 2)))
never, rarely = sigmas(0, 4), sigmas(0.0001, 4)
print("probability 0:", never, "0.0001:", rarely, "first, by hand:", round(by_hand, 3))
assert never == sorted(never) and never[0] > 9 and never[3] > 13
assert rarely == sorted(rarely, reverse=True) and abs(rarely[0] - by_hand) < 0.01
END
