#!/usr/bin/env bash
# pymunk 7.3.1: a ray that begins within a shape, as a lidar's in its own robot, has two answers: the hit's `alpha` is
# 0, its `point` is the far end of the ray. By the one a robot is in a wall, by the other in an empty field. And it
# stops there: the first hit is the robot, and walls beyond it are not seen. A `ShapeFilter` leaves the robot out.
# Seen, a wall at 3 m: alpha 0 and a point at 10 m; with a filter alpha 0.3 and a point at 3 m.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q pymunk==7.3.1
"$folder/bin/python" -W ignore - <<'END'
import pymunk

space, robot = pymunk.Space(), pymunk.Body(1, 1)
hull = pymunk.Circle(robot, 0.2)
hull.filter = pymunk.ShapeFilter(group=1)
space.add(robot, hull, pymunk.Segment(space.static_body, (3, -1), (3, 1), 0))


def look(filter):
    hit = space.segment_query_first((0, 0), (10, 0), 0, filter)
    return round(hit.alpha, 3), round(hit.point.x, 3)


within, without = look(pymunk.ShapeFilter()), look(pymunk.ShapeFilter(group=1))
print("alpha and x of the point:", within, "without the robot:", without)
assert within == (0, 10) and without == (0.3, 3)
END
