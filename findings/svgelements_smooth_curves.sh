#!/usr/bin/env bash
# svgelements 1.9.6: in a path, T after a cubic curve and S after a quadratic one reflect the control point of
# that other kind. By the standard, and in browsers and svgpathtools, they begin straight ahead: T is a line
# there. A curved wall bulges by metres, with no warning.
# Seen: T30,0 after C0,10 10,10 10,0 is a line for svgpathtools, and a curve 5 units away from it here.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q svgelements==1.9.6 svgpathtools==1.8.0
"$folder/bin/python" -W ignore - <<'END'
import svgelements
import svgpathtools


def farthest(first, smooth):
    """Of the last curve's points, how far one is from the line at y = 0."""
    text = f"M0,0 {first} {smooth}"
    theirs, other = svgelements.Path(text)[-1], svgpathtools.parse_path(text)[-1]
    at = [t / 100 for t in range(101)]
    return max(abs(float(theirs.point(t).y)) for t in at), max(abs(other.point(t).imag) for t in at)


same = farthest("Q5,10 10,0", "T30,0")  # where both reflect
other_t, other_s = farthest("C0,10 10,10 10,0", "T30,0"), farthest("Q5,10 10,0", "S30,0 30,0")
print("T after Q:", same, "T after C:", other_t, "S after Q:", other_s)
assert same == (5, 5)
assert other_t == (5, 0) and other_s[0] > 4 and other_s[1] == 0
END
