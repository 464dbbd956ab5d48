"""Draws a sheet of mazes as an image, with a row for each fraction of opened dead ends.

python scripts/show_mazes.py mazes.png --size 8 --corridor 1.0 --thickness 0.2
"""

import argparse
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from matplotlib import pyplot as plt

from megastep import geometry
from megastep.geometries import mazes

BRAIDS = (0.0, 0.5, 1.0)
COLUMNS = 4


def sheet(first=0, size=8, corridor=1.0, thickness=0.2):
    """Returns a figure with four mazes per row, of seeds `first` and up."""
    figure, axes = plt.subplots(
        len(BRAIDS), COLUMNS, figsize=(3.2 * COLUMNS, 3.4 * len(BRAIDS)), layout="constrained"
    )
    for braid, row in zip(BRAIDS, axes):
        for seed, ax in enumerate(row, first):
            g = mazes.generate(seed, size, corridor, thickness, braid)
            opened = mazes.passages(size, braid, mazes.PortableGenerator(seed))
            n_dead_ends = sum(len(exits) == 1 for exits in opened)
            geometry.display(g, ax)
            ax.set_axis_off()
            ax.set_title(
                f"maze {seed}, braid {braid:g}: {n_dead_ends} dead ends, {len(g.walls)} walls",
                fontsize=8,
            )
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("path", help="image file to write, such as mazes.png")
    parser.add_argument("--first", type=int, default=0, help="seed of the first maze")
    parser.add_argument("--size", type=int, default=8, help="cells per side")
    parser.add_argument("--corridor", type=float, default=1.0, help="width of corridors in metres")
    parser.add_argument("--thickness", type=float, default=0.2, help="thickness of walls in metres")
    args = parser.parse_args()
    try:
        figure = sheet(args.first, args.size, args.corridor, args.thickness)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    figure.savefig(args.path, dpi=70)


if __name__ == "__main__":
    main()
