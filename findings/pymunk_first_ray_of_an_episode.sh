#!/usr/bin/env bash
# pymunk 7.3.1: a ray sees a body where it was before it was put elsewhere, until the next step. The first observation
# after a reset, which sets positions and looks, is of the last episode's places; so is a ray between two moves.
# `space.reindex_shapes_for_body(body)` helps.
# Seen: a disc is moved from 1 to 5 m; the distance to it is 0.9 before and after, and 4.9 once it is indexed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q pymunk==7.3.1
"$folder/bin/python" -W ignore - <<'END'
import pymunk

space, body = pymunk.Space(), pymunk.Body(1, 1)
body.position = 1, 0
space.add(body, pymunk.Circle(body, 0.1))


def distance():
    return round(10 * space.segment_query_first((0, 0), (10, 0), 0, pymunk.ShapeFilter()).alpha, 3)


seen = [distance()]
body.position = 5, 0
seen.append(distance())
space.reindex_shapes_for_body(body)
seen.append(distance())
print("before, after the move, and indexed:", seen)
assert seen == [0.9, 0.9, 4.9]
END
