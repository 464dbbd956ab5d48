"""Draws a sheet of mazes as an image: a row for each share of dead ends opened, from none to all.

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
    """A figure with the plans of four mazes in each row, those of seeds `first` and on."""
    figure, axes = plt.subplots(
        len(BRAIDS), COLUMNS, figsize=(3.2 * COLUMNS, 3.4 * len(BRAIDS)), layout="constrained"
    )
    for braid, row in zip(BRAIDS, axes):
        for seed, ax in enumerate(row, first):
            g = mazes.generate(seed, size, corridor, thickness, braid)
            opened = mazes.passages(size, braid, mazes.PortableGenerator(seed))
            n_dead_ends = sum(len(others) == 1 for others in opened)
            geometry.display(g, ax)
            ax.set_axis_off()
            ax.set_title(
                f"maze {seed}, braid {braid:g}: {n_dead_ends} dead ends, {len(g.walls)} walls",
                fontsize=8,
            )
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("path", help="the image to write, say mazes.png")
    parser.add_argument("--first", type=int, default=0, help="the seed of the first maze")
    parser.add_argument("--size", type=int, default=8, help="cells a side")
    parser.add_argument("--corridor", type=float, default=1.0, help="width in metres")
    parser.add_argument("--thickness", type=float, default=0.2, help="of the walls, in metres")
    args = parser.parse_args()
    try:
        figure = sheet(args.first, args.size, args.corridor, args.thickness)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    figure.savefig(args.path, dpi=70)


if __name__ == "__main__":
    main()
