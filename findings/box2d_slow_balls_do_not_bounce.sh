#!/usr/bin/env bash
# Box2D 2.3.10: below 1 m/s nothing bounces, whatever its restitution, and polygons stop short of each other:
# a box of 30 cm that is pushed against a wall rests 1.5 cm before it, a disc half a centimetre. In worlds of
# small robots collisions are plastic, and a gap that a lidar sees is none for bodies.
# Seen, restitution 1: 1.1 m/s come back as -1.1, 1.0 as 0. Gaps of 0.015 and 0.005 m, to a ray 0.015 and 0.005.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q box2d==2.3.10
"$folder/bin/python" -W ignore - <<'END'
import Box2D


def pushed(speed, restitution, force, **shape):
    """The velocity of a body of 1 kg after 5 s, and the gap that a ray finds between it and a wall."""
    world = Box2D.b2World(gravity=(0, 0))
    wall = world.CreateStaticBody(position=(3, 0))
    wall.CreatePolygonFixture(box=(1, 5), restitution=restitution)
    body = world.CreateDynamicBody(position=(1, 0), linearVelocity=(speed, 0), fixedRotation=True)
    kind = body.CreatePolygonFixture if "box" in shape else body.CreateCircleFixture
    kind(density=1, restitution=restitution, **shape)
    for _ in range(300):
        body.ApplyForceToCenter((force, 0), True)
        world.Step(1 / 60, 8, 3)

    class Nearest(Box2D.b2RayCastCallback):
        def ReportFixture(self, fixture, point, normal, fraction):
            self.x = point[0]
            return fraction if fixture.body == wall else -1

    ray = Nearest()
    world.RayCast(ray, body.position, (3, 0))
    return round(body.linearVelocity.x, 3), round(ray.x - body.position.x - 0.15, 3)


fast, slow = pushed(1.1, 1, 0, radius=0.15)[0], pushed(1.0, 1, 0, radius=0.15)[0]
box, disc = pushed(0, 0, 5, box=(0.15, 0.15))[1], pushed(0, 0, 5, radius=0.15)[1]
print("after 1.1 and 1.0 m/s:", fast, slow, "gaps of a box and a disc:", box, disc)
assert (fast, slow) == (-1.1, 0)
assert (box, disc) == (0.015, 0.005)
END
