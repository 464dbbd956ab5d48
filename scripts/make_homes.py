"""Makes the 5,000 homes that come with the package, checks every one, and prints statistics.

    python scripts/make_homes.py                      # writes homes.npz and homes.sha256
    python scripts/make_homes.py --count 1000 --dry   # prints only

The files go to megastep/geometries/data/.
"""

import argparse
import hashlib
import io
import sys
import time
import zipfile
from collections import Counter
from concurrent import futures
from multiprocessing import get_context
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from megastep.geometries import homes
from megastep.geometries.homes import database
from scripts import check_homes

NEAR = 0.3  # metres; cells in which two homes' walls are compared

# Real homes, from CubiCasa5k and Raster-to-Vector: (statistic, percentile, min, max).
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


def statistics(made):
    """{statistic: values} of homes as `homes.generate` makes them."""
    return {
        "walls": [len(g.walls) for g in made],
        "wall length, m": [
            np.linalg.norm(g.walls[:, 1] - g.walls[:, 0], axis=-1).sum() for g in made
        ],
        "long side, m": [np.ptp(g.walls, axis=(0, 1)).max() for g in made],
        "short side, m": [np.ptp(g.walls, axis=(0, 1)).min() for g in made],
        "rooms": [len(g.rooms) for g in made],
        "room area, m2": [area for g in made for area in g.areas],
        "free area, m2": [sum(g.areas) for g in made],
        "door width, m": [width for g in made for width in g.doors],
        "doors per room": [len(g.doors) / len(g.rooms) for g in made],
        "openings": [len(g.openings) for g in made],
    }


def outside(values, bands):
    """Sentences on those of the `bands` that some `statistics` miss."""
    found = [
        (name, percent, np.percentile(values[name], percent), low, high)
        for name, percent, low, high in bands
    ]
    return [
        f"{name}: the {percent} % quantile is {value:.2f}, and {low:g} to {high:g} is real"
        for name, percent, value, low, high in found
        if not low <= value <= high
    ]


def symmetries(points):
    """The 8 images, (8, ..., 2), of integer points (..., 2) under the rotations and reflections of
    the square.
    """
    flips = [points * np.array(signs) for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    return np.stack(flips + [flip[..., ::-1] for flip in flips])


def fingerprint(g):
    """A hash of a home's walls to 5 cm that its rotations, reflections and translations share."""
    images = []
    for image in symmetries(np.rint(g.walls * 20).astype(int)):
        image = np.sort((image - image.min((0, 1))) @ [100_000, 1], axis=1)
        images.append(np.unique(image, axis=0).tobytes())
    return hashlib.sha1(min(images)).hexdigest()


def similarity(made):
    """For each home the largest Jaccard index of its wall cells with those of another, over the 8
    symmetries.
    """
    side = int(np.ceil(max(np.ptp(g.walls, axis=(0, 1)).max() for g in made) / NEAR)) + 2
    cells = np.zeros((8, len(made), side * side), np.float32)
    for k, g in enumerate(made):
        middle = (g.walls.max((0, 1)) + g.walls.min((0, 1))) / 2
        steps = np.linspace(0, 1, 2 * side)[
            :, None, None
        ]  # along each wall, closer together than the cells
        points = (g.walls[:, 0] + (g.walls[:, 1] - g.walls[:, 0]) * steps - middle) / NEAR
        for s, image in enumerate(symmetries(points.reshape(-1, 2))):
            x, y = np.floor(image + side / 2).astype(int).T
            cells[s, k, y * side + x] = 1
    sizes = cells[0].sum(-1)
    best = np.zeros(len(made))
    for image in cells:
        common = image @ cells[0].T
        index = common / (sizes[:, None] + sizes - common)
        np.fill_diagonal(index, 0)
        best = np.maximum(best, index.max(1))
    return best


def adjacency(g):
    """A home's rooms in words, a stand-in for its topology: the sorted kinds and how many gaps
    there are.
    """
    return tuple(sorted(g.rooms)), len(g.doors) + len(g.openings)


def made(seed):
    """The home of a seed, what is wrong with it, and the seconds it took to make."""
    start = time.process_time()
    g = homes.generate(seed)
    took = time.process_time() - start
    return g, check_homes.errors(g), took


def packed(plans):
    """The bytes of a database of homes as `generate` makes them."""
    arrays = {
        "walls": np.concatenate([np.rint(g.walls * 100) for g in plans]).astype("<i2"),
        "lights": np.concatenate([np.rint(g.lights * 100) for g in plans]).astype("<i2"),
        "masks": np.concatenate([g.masks.ravel() for g in plans]).astype("i1"),
        "widths": np.array(
            [(len(g.walls), g.n_outer, len(g.lights), *g.masks.shape) for g in plans], "<i4"
        ),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, values in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # dated 1980: the same homes give the same bytes
            entry.compress_type = zipfile.ZIP_LZMA
            with archive.open(entry, "w") as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
    return buffer.getvalue()


def write(plans, path=database.PATH):
    """Writes a database and, beside it, its sha256 in the form of the command sha256sum. Returns
    the digest.
    """
    content = packed(plans)
    digest = hashlib.sha256(content).hexdigest()
    Path(path).write_bytes(content)
    Path(path).with_suffix(".sha256").write_text(f"{digest}  {Path(path).name}\n")
    return digest


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=database.COUNT)
    parser.add_argument("--dry", action="store_true", help="print and write nothing")
    args = parser.parse_args(argv)
    if args.count < 2 or not args.dry and args.count != database.COUNT:
        parser.error(
            f"--count {args.count} is not allowed: take 2 or more with --dry; {database.COUNT} "
            f"are written"
        )

    with futures.ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        results = list(pool.map(made, range(args.count), chunksize=50))
    plans = [g for g, _, _ in results]
    wrong = [f"home {g.id}: {error}" for g, found, _ in results for error in found]
    values = statistics(plans)
    print(
        f"{args.count} homes, {1e3 * np.mean([took for *_, took in results]):.1f} ms each; "
        f"quantiles 5/25/50/75/95 %"
    )
    for name, column in values.items():
        print(
            f"  {name:16}",
            "  ".join(f"{x:8.2f}" for x in np.percentile(column, [5, 25, 50, 75, 95])),
        )
    kinds = Counter(kind for g in plans for kind in g.rooms)
    print(
        "  rooms a home    ",
        ", ".join(f"{kind} {n / len(plans):.2f}" for kind, n in kinds.most_common()),
    )
    near = similarity(plans[:1_000])
    print(f"  nearest other of {len(near)}: median {np.median(near):.2f}, largest {near.max():.2f}")
    print(
        f"  {len({fingerprint(g) for g in plans})} different plans, "
        f"{len({adjacency(g) for g in plans})} programmes"
    )
    wrong += outside(values, BANDS)
    print("\n".join(wrong) or "  all checks passed, all statistics within the bands of real homes")
    if wrong:
        raise SystemExit(1)
    if not args.dry:
        print(f"{write(plans)}  {database.PATH.name}, {database.PATH.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
