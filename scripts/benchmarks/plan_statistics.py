"""The benchmark `plans`: what imported and generated homes are like."""

from collections.abc import Iterator
from pathlib import Path

import torch
from timing import measurement

from megastep import geometries
from megastep.geometries import checks
from megastep.geometries.plans import imports

TITLES = {"cubicasa": "CubiCasa5k", "houseexpo": "HouseExpo"}
N_BENCH = 512
UNITS = {"m²": "m²", "m": "m", "% of length": "%", "%": "%"}


def plans(device: torch.device, folder: Path | None = None) -> Iterator[dict]:
    """Statistics of homes: of the package's generated ones, and of the plans of CubiCasa5k and
    HouseExpo in `--folder`, which has them in `cubicasa/` and `houseexpo/`; a sample is a home. And
    how many of the benchmark's homes do not pass `megastep check`.
    """
    for source, title in TITLES.items() if folder else ():
        found, _ = imports.run(imports.Options(source), folder / source, lambda n: None, 1)
        yield from _statistics(title, [g for plan in found for g in plan.geometries])
        notes = [note for plan in found for note in plan.notes]
        share = sum(note.n_reachable for note in notes) / sum(note.n_rooms for note in notes)
        yield measurement(f"{title}, rooms that an agent can reach", "%", [100 * share])
    yield from _statistics("generated", imports.generated_homes())
    sentences = [checks.errors(g) for g in geometries.sample("bench", N_BENCH, split="all")]
    counts = {
        "that do not pass": sum(map(bool, sentences)),
        "whose walls cross": sum("cross" in str(some) for some in sentences),
        "with a gap too narrow": sum("cannot reach" in str(some) for some in sentences),
    }
    for what, count in counts.items():
        yield measurement(f"bench, homes {what}", f"of {len(sentences)}", [count])


def _statistics(title, homes) -> Iterator[dict]:
    rows = [imports.statistics(g) for g in homes]
    for name in rows[0]:
        what, _, unit = name.partition(", ")
        yield measurement(f"{title}, {what}", UNITS.get(unit, ""), [row[name] for row in rows])
