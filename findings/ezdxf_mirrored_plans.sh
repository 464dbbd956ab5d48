#!/usr/bin/env bash
# ezdxf 1.4.5: in a plan that was mirrored, as CAD programs do with half a house, lines are read where they are, and
# the numbers of circles, arcs and polylines where they were, by `dxf.center` and `get_points()`. Those are in
# coordinates of the object, whose normal points down then. `ocs().to_wcs` and `vertices_in_wcs()` are right.
# Seen, mirrored at x = 0: a line from 1 to 2 is read at -1 to -2, a polyline at 1 to 2, a pillar at 1.5, not -1.5.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q ezdxf==1.4.5
"$folder/bin/python" -W ignore - <<'END'
import ezdxf
from ezdxf import transform
from ezdxf.math import Matrix44

plan = ezdxf.new().modelspace()
line = plan.add_line((1, 0), (2, 0))
wall = plan.add_lwpolyline([(1, 0), (2, 0)])
pillar = plan.add_circle((1.5, 1), 0.2)
transform.inplace(plan, Matrix44.scale(-1, 1, 1))
as_read = [line.dxf.start.x, line.dxf.end.x], [float(x) for x, _ in wall.get_points("xy")], pillar.dxf.center.x
true = [v.x for v in wall.vertices_in_wcs()], pillar.ocs().to_wcs(pillar.dxf.center).x
print("line, polyline and pillar as they are read:", as_read, "where they are:", true)
assert as_read == ([-1, -2], [1, 2], 1.5) and true == ([-1, -2], -1.5)
END
