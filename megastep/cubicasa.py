"""Floor plans by the name that the original megastep has for them: ``cubicasa.sample(64)``.

The original used CubiCasa5k, whose licence (CC BY-NC) keeps it out of this package. This returns
the homes of :mod:`megastep.geometries.homes` instead: as many, generated to match its statistics.
``cubicasa.sample(64, source="cubicasa")`` returns the real ones, once `megastep import` has
imported them.
"""

from megastep.dotdict import dotdict
from megastep.geometries import sample as _sample

__all__ = ["sample"]


def sample(
    n_geometries: int, split: str = "training", seed: int = 1, source: str = "homes"
) -> list[dotdict]:
    """Returns a list of homes. Arguments are those of :func:`megastep.geometries.sample`."""
    return _sample(source, n_geometries, split, seed)
