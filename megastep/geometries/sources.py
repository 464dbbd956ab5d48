"""The sources of geometries: functions `(n, split, seed, **options) -> list`.

Their arguments are the settings of a run's `geometry`.
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
    """Returns the indices of a split, as a range into a database of `count` geometries. A single
    geometry is in every split.
    """
    training = count - max(1, round(count / 10)) if count > 1 else 1
    return {
        "training": range(training),
        "test": range(training if count > 1 else 0, count),
        "all": range(count),
    }[split]


def _draw_indices(count, n, split, seed):
    """Returns n indices into a database of `count`: a random permutation of the split, repeated."""
    members = _split_range(count, split)
    random = np.random.RandomState(seed % 2**32)  # numpy never changes what it draws
    order = random.permutation(len(members))
    return [members[order[i % len(members)]] for i in range(n)]


def box(n: Count = 1, split: str = "training", seed: Seed = 1, width: float = 5.0) -> list[dotdict]:
    """Returns one empty square room, `width` metres wide, n times."""
    return [toys.box(width)] * n


def column(
    n: Count = 1, split: str = "training", seed: Seed = 1, width: float = 5.0, pillar: float = 1.0
) -> list[dotdict]:
    """Returns one square room with a pillar, `pillar` metres wide, in its middle, n times."""
    return [toys.column(width, pillar)] * n


@functools.lru_cache(maxsize=2)
def _load(path, modified):
    return npz.load(path)


def files(n: Count = 512, split: str = "training", seed: Seed = 1, *, path: str) -> list[dotdict]:
    """Returns geometries from the `.npz` file at `path`. The last tenth of it is the test split."""
    path = Path(path)
    database = _load(path, path.stat().st_mtime_ns if path.exists() else 0)
    return [database[i] for i in _draw_indices(len(database), n, split, seed)]


def homes(
    n: Count = 512, split: str = "training", seed: Seed = 1, outer: bool = True
) -> list[dotdict]:
    """Returns homes from the 5,000 of the package. With `outer=False` they lack the outer faces of
    outer walls, which cannot be seen from inside.
    """
    return [database.home(i, outer) for i in _draw_indices(database.COUNT, n, split, seed)]


def bench(n: Count = 512, split: str = "training", seed: Seed = 1) -> list[dotdict]:
    """Returns homes from the 512 dense ones on which the benchmarks run."""
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
    """Returns mazes of `size` x `size` cells from 5,000 of them.

    Corridors are `corridor` metres wide between walls of `thickness` metres. The fraction `braid`
    of the dead ends is opened.
    """
    from megastep.engine.devices import fit  # imports PyTorch, which reading settings must not

    mazes.validate_lengths(size, corridor, thickness)
    indices = _draw_indices(mazes.COUNT, n, split, seed)
    unique = dict.fromkeys(indices)
    what = f"mazes of {size} x {size} cells"
    fit(len(unique), mazes.bytes_each(size, corridor, thickness), "cpu", what)
    generated = {i: mazes.generate(i, size, corridor, thickness, braid) for i in unique}
    return [generated[i] for i in indices]
