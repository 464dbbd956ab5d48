"""Draws a sheet of homes, or of mazes with a row per fraction of opened dead ends, as an image.

python scripts/show_homes.py homes.png --first 0 --count 20 --density 1 --clutter 0
python scripts/show_homes.py mazes.png --mazes --size 8 --corridor 1.0 --thickness 0.2
"""

import argparse
import sys
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from matplotlib import pyplot as plt

from megastep import geometry
from megastep.geometries import homes, mazes

BRAIDS = (0.0, 0.5, 1.0)


def sheet(plans, titles, columns):
    """Returns a figure with floor plans at one scale."""
    rows = -(-len(plans) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(4 * columns, 4 * rows), squeeze=False, layout="constrained"
    )
    side = max(np.ptp(g.walls, axis=(0, 1)).max() for g in plans) + 1
    for ax in axes.flat:
        ax.set_axis_off()
    for g, title, ax in zip(plans, titles, axes.flat):
        geometry.display(g, ax)
        ax.set(xlim=(0.5, side + 0.5), ylim=(0.5, side + 0.5))
        ax.set_title(title, fontsize=9)
    return figure


def sheet_of_homes(seeds, density=1, clutter=0):
    plans = [homes.generate(seed, density=density, clutter=clutter) for seed in seeds]
    titles = [
        f"home {g.id}: {sum(g.areas):.0f} m², {len(g.rooms)} rooms, {len(g.walls)} walls"
        for g in plans
    ]
    return sheet(plans, titles, columns=5)


def sheet_of_mazes(first=0, size=8, corridor=1.0, thickness=0.2):
    plans, titles = [], []
    for braid in BRAIDS:
        for seed in range(first, first + 4):
            plans.append(mazes.generate(seed, size, corridor, thickness, braid))
            opened = mazes.passages(size, braid, mazes.PortableGenerator(seed))
            n_dead_ends = sum(len(exits) == 1 for exits in opened)
            n_walls = len(plans[-1].walls)
            titles.append(f"maze {seed}, braid {braid:g}: {n_dead_ends} dead ends, {n_walls} walls")
    return sheet(plans, titles, columns=4)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("path", help="image file to write, such as homes.png")
    parser.add_argument("--first", type=int, default=0, help="seed of the first plan")
    parser.add_argument("--count", type=int, default=20, help="number of homes")
    parser.add_argument("--density", type=float, default=1, help="of homes, 1 to 3")
    parser.add_argument("--clutter", type=float, default=0, help="of homes, 0 to 1")
    parser.add_argument("--mazes", action="store_true", help="draw mazes")
    parser.add_argument("--size", type=int, default=8, help="cells per side of mazes")
    parser.add_argument("--corridor", type=float, default=1.0, help="width in metres, of mazes")
    parser.add_argument("--thickness", type=float, default=0.2, help="of mazes' walls in metres")
    args = parser.parse_args(argv)
    if args.count < 1:
        raise SystemExit(f"--count {args.count}: take at least 1.")
    try:
        if args.mazes:
            figure = sheet_of_mazes(args.first, args.size, args.corridor, args.thickness)
        else:
            seeds = range(args.first, args.first + args.count)
            figure = sheet_of_homes(seeds, args.density, args.clutter)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    figure.savefig(args.path, dpi=70)


if __name__ == "__main__":
    main()
