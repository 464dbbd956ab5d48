"""Sources of geometries: `sample("homes", 64)` returns a list of 64 homes. `SOURCES` has all names.

A source is a function `(n, split, seed, **options) -> list` that returns n geometries, equal for
equal arguments. A source of many different geometries keeps a tenth of them for `split="test"`;
`"training"` is the rest, `"all"` both. If n is more than a split holds, its geometries are repeated
in the same order (the same objects, not copies).
"""

import inspect

import numpy as np

from megastep.dotdict import dotdict
from megastep.geometries import files as files
from megastep.geometries import mazes as mazes
from megastep.geometries import sources
from megastep.geometries import toys as toys
from megastep.geometry import centers, indices, masks
from megastep.settings import closest

__all__ = ["SOURCES", "SPLITS", "centers", "indices", "masks", "sample"]

SPLITS = ("training", "test", "all")  # parts of a source
#: The sources by name.
SOURCES = {name: getattr(sources, name) for name in sources.__all__}


def sample(
    name: str, n: int, split: str = "training", seed: int = 1, **options: object
) -> list[dotdict]:
    """Returns n geometries from a source. Equal arguments give equal geometries. Raises ValueError
    for an unknown name, split or option, or a value that the source cannot use.

    Args:
        name: of the source, one of `SOURCES`.
        n: number of geometries.
        split: "training", "test" or "all".
        seed: of the order in which geometries are drawn.
        options: of the source; :mod:`~megastep.geometries.sources` has them.
    """
    if name not in SOURCES:
        raise ValueError(f"Unknown geometry source {name!r}; {closest(name, SOURCES)}")
    if split not in SPLITS:
        raise ValueError(f"Unknown split {split!r}; {closest(split, SPLITS)}")
    allowed = list(inspect.signature(SOURCES[name]).parameters)[3:]
    for option in options:
        if option not in allowed:
            hint = closest(option, allowed) if allowed else "it has none"
            raise ValueError(f"Unknown option of geometry source {name!r}: {option!r}; {hint}")
    if not isinstance(n, (int, np.integer)) or isinstance(n, bool) or n < 1:
        raise ValueError(f"n={n!r} geometries: take an integer of at least 1.")
    if name == "files" and options.get("path") is None:
        raise ValueError("Geometry source 'files' needs path=, an .npz file of geometries.")
    return SOURCES[name](int(n), split, int(seed), **options)
