"""Where geometries come from: `sample("homes", 64)` gives a list of 64 homes; `SOURCES` holds the
names there are.

A source is a function `(n, split, seed, **options) -> list` of n geometries, the same for the same
arguments. Sources that hold many different geometries keep a tenth of them for `split="test"`;
`"training"` is the rest and `"all"` both. When more are asked for than a split holds, its
geometries come again in the same order (the same objects, not copies).
"""

import difflib
import inspect
from typing import Any

import numpy as np

from megastep.dotdict import dotdict
from megastep.geometries import files as files
from megastep.geometries import mazes as mazes
from megastep.geometries import sources
from megastep.geometries import toys as toys
from megastep.geometry import centers, indices, masks

__all__ = ["SOURCES", "SPLITS", "centers", "indices", "masks", "sample"]

SPLITS = ("training", "test", "all")
SOURCES = {name: getattr(sources, name) for name in sources.__all__}


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
    "homes", `path` of "files", `size`, `corridor`, `thickness` and `braid` of "maze". Raises
    ValueError for an unknown name, split or option, and for what the source cannot use; EngineError
    for mazes that do not fit into memory.
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
