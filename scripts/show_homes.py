"""Draws a sheet of homes at one scale, as an image.

python scripts/show_homes.py homes.png --first 0 --count 20 --density 1 --clutter 0
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
from megastep.geometries import homes

COLUMNS = 5
LABELS = {
    "living": "living",
    "bath": "bath",
    "entry": "entry",
    "bedroom": "bed",
    "kitchen": "kitchen",
    "lobby": "lob",
    "closet": "clo",
    "storage": "sto",
    "utility": "util",
    "room": "room",
}


def sheet(seeds, density=1, clutter=0):
    """Returns a figure with the floor plans of the homes of these seeds and the names of rooms."""
    plans = [homes.generate(seed, density=density, clutter=clutter) for seed in seeds]
    rows = -(-len(plans) // COLUMNS)
    figure, axes = plt.subplots(
        rows, COLUMNS, figsize=(4 * COLUMNS, 4 * rows), squeeze=False, layout="constrained"
    )
    side = max(np.ptp(g.walls, axis=(0, 1)).max() for g in plans) + 1
    for ax in axes.flat:
        ax.set_axis_off()
    for g, ax in zip(plans, axes.flat):
        geometry.display(g, ax)
        ax.set(xlim=(0.5, side + 0.5), ylim=(0.5, side + 0.5))
        ax.set_title(
            f"home {g.id}: {sum(g.areas):.0f} m², {len(g.rooms)} rooms, {len(g.walls)} walls",
            fontsize=9,
        )
        for kind, (x, y), area in zip(g.rooms, g.lights, g.areas):
            ax.text(x, y - 0.2, LABELS[kind], ha="center", va="top", fontsize=5 + 2 * (area > 4))
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("path", help="image file to write, such as homes.png")
    parser.add_argument("--first", type=int, default=0, help="seed of the first home")
    parser.add_argument("--count", type=int, default=20, help="number of homes")
    parser.add_argument("--density", type=float, default=1, help="of the homes, 1 to 3")
    parser.add_argument("--clutter", type=float, default=0, help="of the homes, 0 to 1")
    args = parser.parse_args()
    if args.count < 1:
        raise SystemExit(f"--count {args.count}: take at least 1.")
    try:
        seeds = range(args.first, args.first + args.count)
        figure = sheet(seeds, args.density, args.clutter)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    figure.savefig(args.path, dpi=70)


if __name__ == "__main__":
    main()
