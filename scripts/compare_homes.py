"""Prints distributions of floor plans by source, as a table of quantiles.

python scripts/compare_homes.py --count 200 homes homes,density=3 bench
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from megastep import engine, geometries
from megastep.envs.pointgoal import goals
from scripts import check_homes

QUANTILES = 5, 25, 50, 75, 95
JAMB = 0.31  # metres; no wall is thicker
DOORS = 0.5, 1.0  # metres; wider gaps have no door
NEAR, LIMIT = 0.3, 2.0  # metres; distances from walls, the second measured up to


def gaps(g):
    """Returns the widths in metres of the gaps in walls: between faces that are opposite each
    other, of equal extent and no longer than a wall is thick.
    """
    widths = []
    for axis in (0, 1):  # along which the gap is
        ends = np.sort(g.walls[..., 1 - axis].astype(float), 1)
        short = (np.ptp(g.walls[..., axis], axis=1) == 0) & (np.ptp(ends, axis=1) < JAMB)
        by_extent = {}
        for at, extent in zip(g.walls[short, 0, axis].astype(float), ends[short].round(2)):
            by_extent.setdefault(tuple(extent), []).append(at)
        widths += [width for ats in by_extent.values() for width in np.diff(np.sort(ats))]
    return [width for width in widths if DOORS[0] <= width <= DOORS[1]]


def statistics(plans):
    """Returns {statistic: values} of geometries."""
    distances = [check_homes.clearance(g, LIMIT) for g in plans]
    ratio = round(plans[0].res / check_homes.FINE)
    values = {
        "walls per home": [len(g.walls) for g in plans],
        "rooms per home": [g.masks.max() for g in plans],
        "floor area, m²": [],
        "floor nearer than 0.3 m to a wall, %": [],
        "door width, m": [width for g in plans for width in gaps(g)],
        "room width (of the largest disc), m": [],
    }
    for g, distance in zip(plans, distances):
        rooms = np.maximum(g.masks, 0).repeat(ratio, 0).repeat(ratio, 1)
        labels, _ = check_homes.components(distance > check_homes.FINE / 2)
        inside = labels == np.bincount(labels[(rooms > 0) & (labels > 0)]).argmax()
        values["floor area, m²"].append(inside.sum() * check_homes.FINE**2)
        near = 100 * (distance[inside] < NEAR).mean()
        values["floor nearer than 0.3 m to a wall, %"].append(near)
        values["room width (of the largest disc), m"] += [
            2 * distance[rooms == room].max() for room in range(1, g.masks.max() + 1)
        ]
    paths = goals.all_geodesics(plans, engine.AGENT_WIDTH / 2**0.5, seed=1)
    lengths = [layout.lengths[np.isfinite(layout.lengths)] for layout in paths]
    values["shortest path between two places, m"] = np.concatenate(lengths)
    values["longest of a home's shortest paths, m"] = [of_home.max() for of_home in lengths]
    return values


def table(names, columns):
    """Returns a Markdown table of the quantiles of each statistic, a column per source."""
    head = ["quantiles 5 / 25 / 50 / 75 / 95 %", *(f"`{name}`" for name in names)]
    lines = [head, ["---"] * len(head)]
    for statistic in columns[0]:
        highest = max(np.percentile(c[statistic], 95) for c in columns if len(c[statistic]))
        digits = 2 if highest < 5 else 0
        texts = [
            " / ".join(f"{value:.{digits}f}" for value in np.percentile(c[statistic], QUANTILES))
            if len(c[statistic])
            else "none"
            for c in columns
        ]
        lines.append([statistic, *texts])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sources", nargs="+", help="such as homes,density=3")
    parser.add_argument("--count", type=int, default=200, help="plans per source")
    args, columns = parser.parse_args(argv), []
    for source in args.sources:
        name, *options = source.split(",")
        try:
            options = {key: yaml.safe_load(value) for key, value in (o.split("=") for o in options)}
            columns.append(statistics(geometries.sample(name, args.count, "all", **options)))
        except ValueError as error:
            raise SystemExit(str(error)) from None
    print(table(args.sources, columns))


if __name__ == "__main__":
    main()
