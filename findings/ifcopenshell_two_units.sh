#!/usr/bin/env bash
# IfcOpenShell 0.9.0: a building in millimetres has placements in millimetres and shapes in metres. What
# `util.placement.get_local_placement` says of a wall is 1,000 times what `geom.create_shape` says of the same wall,
# and moving its shape by its placement takes it 2 km away. In a building in metres the two are one.
# Seen: x of 2000 and of 2 in millimetres, of 2 and 2 in metres; a wall of 4 m has a shape of 4 in both.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q ifcopenshell==0.9.0.post1 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import ifcopenshell
import ifcopenshell.api.context
import ifcopenshell.api.geometry
import ifcopenshell.api.root
import ifcopenshell.api.unit
import ifcopenshell.geom
import ifcopenshell.util.placement
import ifcopenshell.util.shape
import numpy as np


def x_of_wall(**prefix):
    """Returns the x of a wall at 2 m by its placement and by its shape, and its shape's length."""
    api, file = ifcopenshell.api, ifcopenshell.file(schema="IFC4")
    api.root.create_entity(file, ifc_class="IfcProject")
    unit = api.unit.add_si_unit(file, unit_type="LENGTHUNIT", **prefix)
    api.unit.assign_unit(file, units=[unit])
    model = api.context.add_context(file, context_type="Model")
    about = dict(context_type="Model", context_identifier="Body", target_view="MODEL_VIEW", parent=model)
    body = api.context.add_context(file, **about)
    wall = api.root.create_entity(file, ifc_class="IfcWall")
    solid = api.geometry.add_wall_representation(file, context=body, length=4, height=3, thickness=0.2)
    api.geometry.assign_representation(file, product=wall, representation=solid)
    place = np.eye(4)
    place[0, 3] = 2  # metres
    api.geometry.edit_object_placement(file, product=wall, matrix=place, is_si=True)
    shape = ifcopenshell.geom.create_shape(ifcopenshell.geom.settings(), wall)
    placement = ifcopenshell.util.placement.get_local_placement(wall.ObjectPlacement)
    length = float(np.ptp(ifcopenshell.util.shape.get_vertices(shape.geometry)[:, 0]))
    return float(placement[0, 3]), float(ifcopenshell.util.shape.get_shape_matrix(shape)[0, 3]), length


millimetres, metres = x_of_wall(prefix="MILLI"), x_of_wall()
print("placement, shape and length in millimetres:", millimetres, "in metres:", metres)
assert millimetres == (2000, 2, 4) and metres == (2, 2, 4)
END
