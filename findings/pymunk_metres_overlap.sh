#!/usr/bin/env bash
# pymunk 7.3.1: bodies may overlap by 0.1 units, `Space.collision_slop`, for good. In a world in metres a crate
# of 30 cm that is 9 cm inside a wall stays there, at rest, and a ray from the crate ends behind the wall's
# face. In centimetres the same crate is out after a second; so it is in metres with a slop of 0.001.
# Seen, overlaps after a minute, in metres: 0.09 of 0.09, and 0.001 in centimetres.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q pymunk==7.3.1
"$folder/bin/python" -W ignore - <<'END'
import pymunk


def overlap_after_a_minute(unit, **options):
    """In metres, of a crate that begins 9 cm inside a wall, in a world of so many units a metre."""
    space = pymunk.Space()
    for name, value in options.items():
        setattr(space, name, value)
    corners = [(x * unit, y * unit) for x, y in [(1, -5), (2, -5), (2, 5), (1, 5)]]
    body = pymunk.Body(1, 0.015 * unit**2)
    body.position = (1 - 0.15 + 0.09) * unit, 0
    space.add(body, pymunk.Poly.create_box(body, (0.3 * unit, 0.3 * unit)), pymunk.Poly(space.static_body, corners))
    for _ in range(60 * 60):
        space.step(1 / 60)
    return round(body.position.x / unit + 0.15 - 1, 4)


metres, centimetres = overlap_after_a_minute(1), overlap_after_a_minute(100)
smaller = overlap_after_a_minute(1, collision_slop=0.001)
print("metres:", metres, "centimetres:", centimetres, "metres with a slop of 0.001:", smaller)
assert (metres, centimetres, smaller) == (0.09, 0.001, 0.001)
END
