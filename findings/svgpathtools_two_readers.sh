#!/usr/bin/env bash
# svgpathtools 1.8.0: `svg2paths` ignores every `transform`, its `Document` applies them: one file, two floor
# plans. Both give no warning.
# Seen: a line from 0 to 1 in a group moved by 5 stays at 0 or is moved to 5; a square scaled by 3 has a side of 2 or 6.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q svgpathtools==1.8.0
"$folder/bin/python" -W ignore - <<'END'
import tempfile

import svgpathtools

with tempfile.NamedTemporaryFile("w", suffix=".svg", delete=False) as file:
    file.write("""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 10 10">
    <g transform="translate(5,0)"><path d="M0 0L1 0"/></g>
    <rect width="2" height="2" transform="scale(3)"/></svg>""")


def ends(paths):
    return sorted(max(abs(line.end) for line in path) for path in paths)


plain, placed = ends(svgpathtools.svg2paths(file.name)[0]), ends(svgpathtools.Document(file.name).paths())
print("svg2paths:", plain, "Document:", placed)
assert plain == [1, abs(2 + 2j)] and placed == [6, abs(6 + 6j)]
END
