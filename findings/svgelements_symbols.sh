#!/usr/bin/env bash
# svgelements 1.9.6: `SVG.parse` draws a <symbol> where it is defined, lets shapes inherit `x` and `y` of
# their group, and knows no descendant selectors. Browsers draw a symbol only where it is used, take
# geometry from the shape alone, and paint `.a .b`.
# Seen: an unused symbol is a shape; a rect in <g x="7"> begins at 7; the rect of `.a .b {fill: red}` is black.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q svgelements==1.9.6
"$folder/bin/python" -W ignore - <<'END'
import io

from svgelements import SVG, Path, Shape

HEAD = '<svg xmlns="http://www.w3.org/2000/svg" width="100" height="100" viewBox="0 0 100 100">'


def shapes(body):
    drawing = SVG.parse(io.StringIO(f"{HEAD}{body}</svg>"))
    return [element for element in drawing.elements() if isinstance(element, Shape)]


rect = '<rect class="b" width="3" height="5"/>'
(symbol,) = shapes(f"<symbol>{rect}</symbol>")
(moved,) = shapes(f'<g x="7">{rect}</g>')
(painted,) = shapes(f'<style>.a .b{{fill:#ff0000}}</style><g class="a">{rect}</g>')
print(Path(symbol).d(), "|", Path(moved).d(), "|", painted.fill)
assert Path(symbol).d().startswith("M 0,0") and Path(moved).d().startswith("M 7,0")
assert str(painted.fill) == "#000000"
END
