"""The benchmark `plans`: what imported and generated homes are like."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from timing import measurement

from megastep import geometries
from megastep.envs.pointgoal.goals import all_geodesics
from megastep.geometries import checks

TITLES = {"cubicasa": "CubiCasa5k", "houseexpo": "HouseExpo"}
DENSE = {
    "density 3": ("homes", {"density": 3.0}),
    "density 3, clutter 1": ("homes", {"density": 3.0, "clutter": 1.0}),
    "bench": ("bench", {}),
}
N_DENSE, N_BENCH = 200, 512
UNITS = {"m²": "m²", "m": "m", "% of length": "%", "%": "%"}


def plans(device: torch.device, folder: Path | None = None) -> Iterator[dict]:
    """Statistics of homes: of the package's generated ones, and of the plans of CubiCasa5k and
    HouseExpo in `--folder`, which has them in `cubicasa/` and `houseexpo/`; a sample is a home, a
    room or a path. And how many of the benchmark's homes do not pass `megastep check`.
    """
    from megastep.geometries.plans import imports  # and with it what only plans need

    for source, title in TITLES.items() if folder else ():
        found, _ = imports.run(imports.Options(source), folder / source, lambda n: None, 1)
        homes = [g for plan in found for g in plan.geometries]
        yield from _of_homes(title, homes, imports.statistics)
        notes = [note for plan in found for note in plan.notes]
        share = sum(note.n_reachable for note in notes) / sum(note.n_rooms for note in notes)
        yield measurement(f"{title}, rooms that an agent can reach", "%", [100 * share])
    for title, homes in {"generated": imports.generated_homes(), **_dense()}.items():
        yield from _of_homes(title, homes, imports.statistics)
        yield from _of_paths(title, homes)
    sentences = [checks.errors(g) for g in geometries.sample("bench", N_BENCH, split="all")]
    counts = {
        "that do not pass": sum(map(bool, sentences)),
        "whose walls cross": sum("cross" in str(some) for some in sentences),
        "with a gap too narrow": sum("cannot reach" in str(some) for some in sentences),
    }
    for what, count in counts.items():
        yield measurement(f"bench, homes {what}", f"of {len(sentences)}", [count])


def _dense() -> dict[str, list]:
    return {
        title: geometries.sample(source, N_DENSE, split="all", **options)
        for title, (source, options) in DENSE.items()
    }


def _of_homes(title, homes, statistics) -> Iterator[dict]:
    rows = [statistics(g) for g in homes]
    for name in rows[0]:
        if name == "doors" and "doors" not in homes[0]:
            continue  # they are not marked
        what, _, unit = name.partition(", ")
        yield measurement(f"{title}, {what}", UNITS.get(unit, ""), [row[name] for row in rows])


def _of_paths(title, homes) -> Iterator[dict]:
    """Yields what an agent meets on its way: rooms, by their largest discs, and shortest paths."""
    widths = []
    for g in homes:
        clearance, rooms, cell = checks.fine_rooms(g, checks.FINE)  # clearance only up to 0.3 m
        distance = cell * ndimage.distance_transform_edt(clearance > 0.75 * cell)
        widths += [2 * d for d in ndimage.maximum(distance, rooms, range(1, rooms.max() + 1))]
    lengths = [layout.lengths for layout in all_geodesics(homes, checks.RADIUS, seed=0)]
    yield measurement(f"{title}, room width", "m", widths)
    yield measurement(f"{title}, shortest path", "m", np.concatenate(lengths).ravel().tolist())
    yield measurement(
        f"{title}, longest of a home's shortest paths", "m", [one.max() for one in lengths]
    )
