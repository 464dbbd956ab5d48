#!/usr/bin/env bash
# ezdxf 1.4.5: `addons.geo.proxy` makes polygons for GIS, with curves within 0.1 drawing units. In a plan in metres a
# round pillar of 1 m is a pentagon with three quarters of its area, one of 30 cm a triangle, and arcs of walls
# lose as much; in millimetres the same pillar is round. `proxy(entity, distance=0.001)` is, too.
# Seen, areas as fractions of the circle's: 0.76 and 0.41 in metres, above 0.999 in millimetres.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q ezdxf==1.4.5
"$folder/bin/python" -W ignore - <<'END'
import math

import ezdxf
from ezdxf.addons import geo


def corners_and_area(radius, **options):
    circle = ezdxf.new().modelspace().add_circle((3 * radius, 2 * radius), radius)
    (ring,) = geo.proxy(circle, **options).__geo_interface__["coordinates"]
    area = sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(ring, ring[1:])) / 2
    return len(ring) - 1, round(abs(area) / (math.pi * radius**2), 3)


metres, small, fine = corners_and_area(0.5), corners_and_area(0.15), corners_and_area(0.5, distance=0.001)
millimetres = corners_and_area(500)
print("1 m:", metres, "30 cm:", small, "in mm:", millimetres, "distance=0.001:", fine)
assert metres == (5, 0.757) and small == (3, 0.413)
assert millimetres[1] > 0.999 and fine[1] > 0.99
END
