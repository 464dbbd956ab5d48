#!/usr/bin/env bash
# PyTMX 3.32: walls that are tiles placed as objects of a Tiled map, and turned, are read in another place. Tiled
# turns a tile about its bottom left corner, which is the object's x and y; `apply_transformations` turns it about
# the top left one. A polygon with the same corners, origin and angle is turned as in Tiled: the two come apart.
# Seen: not turned, both cover 64 to 96 in x and y. Turned by 90 degrees, the polygon covers 64 to 96 in x and 96 to
# 128 in y, the tile 32 to 64 and 64 to 96.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q pytmx==3.32 pillow==12.0.0
"$folder/bin/python" -W ignore - <<'END'
import pathlib
import tempfile

import pytmx
from PIL import Image

folder = pathlib.Path(tempfile.mkdtemp())
Image.new("L", (32, 32)).save(folder / "wall.png")
objects = "".join(
    f"""<object id="{angle + 1}" name="tile {angle}" gid="1" x="64" y="96" width="32" height="32" rotation="{angle}"/>
    <object id="{angle + 2}" name="polygon {angle}" x="64" y="96" rotation="{angle}">
      <polygon points="0,0 32,0 32,-32 0,-32"/>
    </object>"""
    for angle in (0, 90)
)
(folder / "plan.tmx").write_text(f"""<?xml version="1.0" encoding="UTF-8"?>
<map version="1.10" orientation="orthogonal" width="10" height="10" tilewidth="32" tileheight="32">
  <tileset firstgid="1" name="walls" tilewidth="32" tileheight="32" tilecount="1" columns="1">
    <image source="wall.png" width="32" height="32"/>
  </tileset>
  <objectgroup id="1" name="walls">{objects}</objectgroup>
</map>""")


def box(wall):
    """Returns the least and greatest x and y of an object's corners."""
    xs, ys = ([round(x) for x in axis] for axis in zip(*wall.apply_transformations()))
    return min(xs), max(xs), min(ys), max(ys)


boxes = {wall.name: box(wall) for wall in pytmx.TiledMap(str(folder / "plan.tmx")).get_layer_by_name("walls")}
print(boxes)
assert boxes["tile 0"] == boxes["polygon 0"] == (64, 96, 64, 96)
assert boxes["polygon 90"] == (64, 96, 96, 128) and boxes["tile 90"] == (32, 64, 64, 96)
END
