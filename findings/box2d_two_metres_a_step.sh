#!/usr/bin/env bash
# Box2D 2.3.10: no body moves by more than 2 m, or turns by more than a quarter, in a step. Where an agent
# decides 10 times a second and the world steps once per decision, everything above 20 m/s, or 15.7 rad/s,
# is slowed down, with nothing in its way, for good. At 60 steps a second the same body keeps its speed.
# Seen, a second at 30 m/s: 20 m at 10 Hz and a velocity of 20 after it, 30 m at 60 Hz; 20 rad/s become 15.7.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q box2d==2.3.10
"$folder/bin/python" -W ignore - <<'END'
import math

import Box2D


def after_a_second(hz, speed, turning):
    world = Box2D.b2World(gravity=(0, 0))
    body = world.CreateDynamicBody(linearVelocity=(speed, 0), angularVelocity=turning)
    body.CreateCircleFixture(radius=0.1, density=1)
    for _ in range(hz):
        world.Step(1 / hz, 8, 3)
    return round(body.position.x, 3), round(body.linearVelocity.x, 3), round(body.angularVelocity, 3)


slow, fast, below = after_a_second(10, 30, 20), after_a_second(60, 30, 20), after_a_second(10, 19, 15)
print("10 Hz:", slow, "60 Hz:", fast, "below the limits:", below)
assert slow == (20, 20, round(5 * math.pi, 3))
assert fast == (30, 30, 20) and below == (19, 19, 15)
END
