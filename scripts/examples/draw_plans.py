"""Draws six floor plans that are not easy to import, as people and robots leave them: three SVG
drawings and three maps. docs/floor-plans.md shows them beside what `megastep import` makes of them.

    python scripts/examples/draw_plans.py FOLDER
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

SVG = (
    '<svg xmlns="http://www.w3.org/2000/svg" {0} '
    'xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape">{1}</svg>'
)
# A wall ring of 10 m x 6 m, with an inner wall and a doorway of 0.9 m, in metres.
OUTER, INNER = [(0, 0), (10, 0), (10, 6), (0, 6)], [(0.3, 0.3), (9.7, 0.3), (9.7, 5.7), (0.3, 5.7)]
DIVIDERS = [(5, 0.3, 5.15, 2.2), (5, 3.1, 5.15, 5.7), (5.15, 3.8, 7, 3.95), (7.9, 3.8, 9.7, 3.95)]


def curved():
    """A house with a round room: a path of arcs and Bezier curves, metres, marked by a class."""
    walls = "M0 0H8V6H5.5C5.5 9 0 9 0 6Z M.2 .2V6C.2 8.6 5.3 8.6 5.3 6V5.8H7.8V.2Z"
    round_corner = "M3.4 3.4H4.6A1 1 0 0 0 5.6 2.4V.2H5.7V2.4A1.1 1.1 0 0 1 4.6 3.5H3.4Z"
    inner = f"M.2 3.4H2.5V3.5H.2Z {round_corner}"
    door = '<rect class="door" x="2.5" y="3.4" width=".9" height=".1"/>'
    shapes = f'<path class="thick wall" d="{walls}"/><path class="wall" d="{inner}"/>{door}'
    return SVG.format('viewBox="-1 -1 10 10"', shapes)


def millimetres():
    """A plan in millimetres, as strokes of lines in a layer that is called Walls."""
    lines = [(0, 0, 9000, 0), (9000, 0, 9000, 7000), (0, 7000, 9000, 7000), (0, 0, 0, 7000)]
    lines += [(4000, 0, 4000, 2500), (4000, 3400, 4000, 7000), (4000, 4500, 6000, 4500)]
    lines += [(6900, 4500, 9000, 4500)]
    text = "".join(f'<line x1="{a}" y1="{b}" x2="{c}" y2="{d}"/>' for a, b, c, d in lines)
    style = 'style="stroke:#000;stroke-width:150"'
    layer = f'<g inkscape:groupmode="layer" inkscape:label="Walls" {style}>{text}</g>'
    return SVG.format('viewBox="0 0 9000 7000"', f'{layer}<text x="1" y="1">living</text>')


def transformed():
    """A flat at 1 : 50 in millimetres, drawn on its side within nested transforms, with a gap as
    its entrance.
    """
    ring = "0,0 200,0 200,120 0,120 0,60 6,60 6,114 194,114 194,6 6,6 6,42 0,42"
    rows = [
        f'<rect x="{x0 * 20}" y="{y0 * 20}" width="{(x1 - x0) * 20}" height="{(y1 - y0) * 20}"/>'
        for x0, y0, x1, y1 in DIVIDERS
    ]
    walls = f'<g id="wall-1"><polygon points="{ring}"/>{"".join(rows)}</g>'
    turned = f'<g transform="rotate(90) translate(5 -130)">{walls}</g>'
    group = f'<g transform="translate(40 200) scale(1 -1)">{turned}</g>'
    return SVG.format('width="300" height="300"', group)


def plan_image(metre, unknown=False):
    """The flat of OUTER, INNER and DIVIDERS as an image: floor 254, walls 0, outside 205 or 254."""
    image = Image.new("L", (12 * metre, 8 * metre), 205 if unknown else 254)
    draw = ImageDraw.Draw(image)

    def box(x0, y0, x1, y1, value):
        left, top, right, bottom = (round((v + 1) * metre) for v in (x0, y0, x1, y1))
        draw.rectangle((left, top, right - 1, bottom - 1), value)

    box(*OUTER[0], *OUTER[2], 0)
    box(*INNER[0], *INNER[2], 254)
    for wall in DIVIDERS:
        box(*wall, 0)
    return image


def rotated_scan(folder):
    """A scan of paper, turned by 3.4 degrees and blurred, 2 cm a pixel."""
    image = plan_image(50).rotate(3.4, Image.Resampling.BICUBIC, expand=True, fillcolor=254)
    noise = np.random.default_rng(1).normal(0, 12, image.size[::-1])
    values = np.clip(np.asarray(image) + noise, 0, 255)
    Image.fromarray(values.astype(np.uint8)).save(folder / "scan.png")


def ros_map(folder, name, values, resolution):
    Image.fromarray(values.astype(np.uint8)).save(folder / f"{name}.pgm")
    (folder / f"{name}.yaml").write_text(
        f"image: {name}.pgm\nresolution: {resolution}\norigin: [-6.0, -4.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def speckled_slam(folder):
    """A map of SLAM, 5 cm a cell: one cell in thirty of the floor is noise, walls are ragged."""
    random = np.random.default_rng(2)
    values = np.asarray(plan_image(20, unknown=True)).copy()
    noise = random.random(values.shape)
    values[(values == 254) & (noise < 1 / 30)] = 0
    values[(values == 0) & (noise > 0.97)] = 205
    ros_map(folder, "slam", values, 0.05)


def unknown_cells(folder):
    """A map whose robot did not see a corner of a room, nor half of an outer wall."""
    values = np.asarray(plan_image(20, unknown=True)).copy()
    values[100:140, 20:80] = 205
    values[20:26, 120:200] = 205
    ros_map(folder, "partly", values, 0.05)


DRAWINGS = {"curved": curved, "millimetres": millimetres, "transformed": transformed}
#: The words of `megastep import` for each file.
WORDS = {
    "curved.svg": ["source=svg", "scale=1"],
    "millimetres.svg": ["source=svg", "scale=0.001", "walls=Walls"],
    "transformed.svg": ["source=svg", "scale=0.05"],
    "scan.png": ["source=map", "metres_per_pixel=0.02"],
    "slam.yaml": ["source=map"],
    "partly.yaml": ["source=map"],
}


def main(folder):
    """Writes the six plans into a folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in DRAWINGS.items():
        (folder / f"{name}.svg").write_text(draw())
    for draw in (rotated_scan, speckled_slam, unknown_cells):
        draw(folder)


def curved_house():
    """Returns the geometry of the house with a round room."""
    from megastep.geometries.plans import imports

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "curved.svg")
        path.write_text(curved())
        return imports.own_svg(path, scale=1.0).geometry


def sheet(path):
    """Draws the six plans beside what they become, into an image."""
    from megastep.geometries.plans import imports, sheets

    with tempfile.TemporaryDirectory() as folder:
        main(folder)
        pairs = []
        for name, words in WORDS.items():
            given = dict(word.split("=") for word in words)
            own = imports.own_map if given.pop("source") == "map" else imports.own_svg
            numbers = {key: float(given[key]) for key in given if key != "walls"}
            plan = own(Path(folder) / name, **(given | numbers))
            pairs.append((name, plan.original, plan.geometry))
    sheets.write(Path(path), pairs, columns=3)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split(".")[0])
    parser.add_argument("folder", help="is made if it does not exist")
    main(parser.parse_args().folder)
