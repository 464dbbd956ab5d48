"""Generates the 5,000 homes of the package, checks them, and prints statistics.

    python scripts/make_homes.py                      # writes homes.npz
    python scripts/make_homes.py --count 1000 --dry   # prints only
    python scripts/make_homes.py --count 1000 --dry --density 3 --clutter 1

The file goes to megastep/geometries/data/.
"""

import argparse
import hashlib
import itertools
import sys
import time
from collections import Counter
from concurrent import futures
from multiprocessing import get_context
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from megastep.geometries import databases, homes
from scripts import check_homes

# Of real homes, from CubiCasa5k and Raster-to-Vector: (statistic, percentile, min, max).
BANDS = [
    ("walls", 5, 30, 55),
    ("walls", 50, 55, 90),
    ("walls", 95, 95, 170),
    ("wall length, m", 50, 90, 130),
    ("long side, m", 50, 9, 12.5),
    ("rooms", 50, 7, 10),
    ("rooms", 95, 12, 19),
    ("room area, m2", 50, 4, 8),
    ("free area, m2", 50, 50, 72),
    ("door width, m", 50, 0.70, 0.90),
    ("doors per room", 50, 0.7, 1.0),
]


def statistics(plans):
    """Returns {statistic: values} of homes from `homes.generate`."""
    return {
        "walls": [len(g.walls) for g in plans],
        "wall length, m": [
            np.linalg.norm(g.walls[:, 1] - g.walls[:, 0], axis=-1).sum() for g in plans
        ],
        "long side, m": [np.ptp(g.walls, axis=(0, 1)).max() for g in plans],
        "short side, m": [np.ptp(g.walls, axis=(0, 1)).min() for g in plans],
        "rooms": [len(g.rooms) for g in plans],
        "room area, m2": [area for g in plans for area in g.areas],
        "free area, m2": [sum(g.areas) for g in plans],
        "door width, m": [
            width for g in plans for width in np.abs(g.doors[:, 1] - g.doors[:, 0]).sum(-1)
        ],
        "doors per room": [len(g.doors) / len(g.rooms) for g in plans],
        "openings": [len(g.openings) for g in plans],
    }


def outside(values, bands):
    """Returns a sentence for each of `bands` that the `statistics` are outside of."""
    messages = []
    for name, percent, low, high in bands:
        value = np.percentile(values[name], percent)
        if not low <= value <= high:
            messages.append(
                f"{name}: the {percent} % quantile is {value:.2f}, but {low:g} to {high:g} in real "
                f"homes"
            )
    return messages


def symmetries(points):
    """Returns the 8 images, (8, ..., 2), of points (..., 2) under the rotations and reflections of
    the square.
    """
    flips = [points * np.array(signs) for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    return np.stack(flips + [flip[..., ::-1] for flip in flips])


def fingerprint(g):
    """Returns a hash of a home's walls, rounded to 5 cm, that does not change under rotation,
    reflection and translation.
    """
    images = []
    for image in symmetries(np.rint(g.walls * 20).astype(int)):
        image = np.sort((image - image.min((0, 1))) @ [100_000, 1], axis=1)
        images.append(np.unique(image, axis=0).tobytes())
    return hashlib.sha1(min(images)).hexdigest()


def generate(seed, density=1, clutter=0):
    """Returns (the home of a seed, its errors, the seconds that it took)."""
    start = time.process_time()
    g = homes.generate(seed, density=density, clutter=clutter)
    seconds = time.process_time() - start
    return g, check_homes.errors(g, clutter > 0), seconds


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=databases.COUNT)
    parser.add_argument("--dry", action="store_true", help="print and write nothing")
    parser.add_argument("--density", type=float, default=1, help="1 to 3; with --dry")
    parser.add_argument("--clutter", type=float, default=0, help="0 to 1; with --dry")
    args = parser.parse_args(argv)
    if not args.dry and (args.count, args.density, args.clutter) != (databases.COUNT, 1, 0):
        parser.error("--count, --density and --clutter need --dry")
    with futures.ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        options = map(itertools.repeat, (args.density, args.clutter))
        results = list(pool.map(generate, range(args.count), *options, chunksize=50))
    plans = [g for g, _, _ in results]
    messages = [f"home {g.id}: {error}" for g, errors, _ in results for error in errors]
    values = statistics(plans)
    milliseconds = 1e3 * np.mean([seconds for *_, seconds in results])
    print(f"{args.count} homes, {milliseconds:.1f} ms each; quantiles 5/25/50/75/95 %")
    for name, column in values.items():
        print(
            f"  {name:16}",
            "  ".join(f"{x:8.2f}" for x in np.percentile(column, [5, 25, 50, 75, 95])),
        )
    kinds = Counter(kind for g in plans for kind in g.rooms)
    print(
        "  rooms per home  ",
        ", ".join(f"{kind} {n / len(plans):.2f}" for kind, n in kinds.most_common()),
    )
    print(f"  {len({fingerprint(g) for g in plans})} different plans")
    passed = "  all checks passed"
    if args.density == 1 and args.clutter == 0:
        messages += outside(values, BANDS)
        passed += ", all statistics within the bands of real homes"
    print("\n".join(messages) or passed)
    if messages:
        raise SystemExit(1)
    if not args.dry:
        print(f"{databases.PATH.write_bytes(databases.pack(plans)):,} bytes in {databases.PATH}")


if __name__ == "__main__":
    main()
