"""Where geometries come from: `sample("homes", 64)` gives a list of 64 homes; `SOURCES` holds the
names there are.

A source is a function `(n, split, seed, **options) -> list` of n geometries, the same for the same
arguments. Sources that hold many different geometries keep a tenth of them for `split="test"`;
`"training"` is the rest and `"all"` both. When more are asked for than a split holds, its
geometries come again in the same order (the same objects, not copies).
"""

import difflib
import functools
import inspect
from pathlib import Path
from typing import Any

import numpy as np

from ..dotdict import dotdict
from ..geometry import centers, indices, masks
from . import files, toys
from .homes import database

__all__ = ["SOURCES", "SPLITS", "centers", "indices", "masks", "sample"]

SPLITS = ("training", "test", "all")
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


def _box(n, split, seed, width=5):
    return [toys.box(width)] * n


def _column(n, split, seed, width=5, pillar=1):
    return [toys.column(width, pillar)] * n


@functools.lru_cache(maxsize=2)
def _loaded(path, changed):
    return files.load(path)


def _files(n, split, seed, path):
    """From the `.npz` file at `path`; the last tenth of it is the test split."""
    path = Path(path)
    database = _loaded(path, path.stat().st_mtime_ns if path.exists() else 0)
    return [database[i] for i in _selected(len(database), n, split, seed)]


def _homes(n, split, seed, outer=True):
    """From the 5,000 homes; without the outer face of their envelopes if not `outer`."""
    return [database.home(index, outer) for index in _selected(database.COUNT, n, split, seed)]


def _bench(n, split, seed):
    """The 512 dense homes every benchmark runs on."""
    return _files(n, split, seed, BENCH)


SOURCES = {"box": _box, "column": _column, "homes": _homes, "bench": _bench, "files": _files}


def _known(kind, given, allowed):
    """Raises ValueError, naming the nearest allowed value, unless `given` is one of `allowed`."""
    if given not in allowed:
        near = difflib.get_close_matches(str(given), allowed, 1, 0)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(
            f"There is no {kind} {given!r}; {hint}There are: {', '.join(allowed) or 'none'}."
        )


def sample(
    name: str, n: int, split: str = "training", seed: int = 1, **options: Any
) -> list[dotdict]:
    """A list of n geometries from the source `name`, the same for the same arguments.

    `options` are the source's own: `width` of "box", `width` and `pillar` of "column", `outer` of
    "homes", `path` of "files". Raises ValueError for an unknown name, split or option, and for what
    the source cannot use.
    """
    _known("geometry source", name, SOURCES)
    _known("split", split, SPLITS)
    allowed = list(inspect.signature(SOURCES[name]).parameters)[3:]
    for option in options:
        _known(f"option of geometry source {name!r} called", option, allowed)
    if not isinstance(n, (int, np.integer)) or isinstance(n, bool) or n < 1:
        raise ValueError(f"n={n!r} geometries cannot be sampled; take an integer of 1 or more.")
    if name == "files" and options.get("path") is None:
        raise ValueError(
            "Geometry source 'files' needs its option path, an .npz file of geometries."
        )
    return SOURCES[name](int(n), split, int(seed), **options)
