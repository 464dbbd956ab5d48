"""The sources of geometries, each a function `(n, split, seed, **options) -> list`; settings of a
run are their arguments.
"""

import functools
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from megastep.dotdict import dotdict
from megastep.geometries import files as npz
from megastep.geometries import mazes, toys
from megastep.geometries.homes import database
from megastep.settings import checked

__all__ = ["bench", "box", "column", "files", "homes", "maze"]

Count = Annotated[int, Field(ge=1, le=1_000_000)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
BENCH = Path(__file__).parent / "data" / "bench_homes.npz"


def _split_range(count, split):
    """The range of a database of `count` geometries that `split` holds; a single one is in every
    split.
    """
    training = count - max(1, round(count / 10)) if count > 1 else 1
    return {
        "training": range(training),
        "test": range(training if count > 1 else 0, count),
        "all": range(count),
    }[split]


def _selected(count, n, split, seed):
    """n indices into a database of `count`: the split in an order drawn from `seed`, over and
    over.
    """
    members = _split_range(count, split)
    order = np.random.RandomState(seed % 2**32).permutation(
        len(members)
    )  # a stream numpy promises never to change
    return [members[order[i % len(members)]] for i in range(n)]


def box(n: Count = 1, split: str = "training", seed: Seed = 1, width: float = 5.0) -> list[dotdict]:
    """One empty square room, `width` metres wide, n times."""
    return [toys.box(width)] * n


def column(
    n: Count = 1, split: str = "training", seed: Seed = 1, width: float = 5.0, pillar: float = 1.0
) -> list[dotdict]:
    """One square room with a square column of `pillar` metres in its middle, n times."""
    return [toys.column(width, pillar)] * n


@functools.lru_cache(maxsize=2)
def _loaded(path, changed):
    return npz.load(path)


def files(n: Count = 512, split: str = "training", seed: Seed = 1, *, path: str) -> list[dotdict]:
    """From the `.npz` file at `path`; the last tenth of it is the test split."""
    path = Path(path)
    database = _loaded(path, path.stat().st_mtime_ns if path.exists() else 0)
    return [database[i] for i in _selected(len(database), n, split, seed)]


def homes(
    n: Count = 512, split: str = "training", seed: Seed = 1, outer: bool = True
) -> list[dotdict]:
    """From the 5,000 homes; without the outer face of their envelopes if not `outer`."""
    return [database.home(index, outer) for index in _selected(database.COUNT, n, split, seed)]


def bench(n: Count = 512, split: str = "training", seed: Seed = 1) -> list[dotdict]:
    """The 512 dense homes every benchmark runs on."""
    return files(n, split, seed, path=BENCH)


@checked
def maze(
    n: Count = 512,
    split: str = "training",
    seed: Seed = 1,
    size: Annotated[int, Field(ge=2, le=32)] = 8,
    corridor: Annotated[float, Field(gt=0, le=100)] = 1.0,
    thickness: Annotated[float, Field(ge=0.02, le=100)] = 0.2,
    braid: Annotated[float, Field(ge=0, le=1)] = 0.0,
) -> list[dotdict]:
    """From 5,000 mazes of `size` x `size` cells, `corridor` metres wide between walls of
    `thickness`, with the share `braid` of their dead ends opened.
    """
    from megastep.engine.devices import fit  # brings PyTorch, without which settings are read

    mazes.checked(size, corridor, thickness)
    indices = _selected(mazes.COUNT, n, split, seed)
    different = dict.fromkeys(indices)
    what = f"mazes of {size} x {size} cells"
    fit(len(different), mazes.bytes_each(size, corridor, thickness), "cpu", what)
    made = {i: mazes.generate(i, size, corridor, thickness, braid) for i in different}
    return [made[i] for i in indices]
