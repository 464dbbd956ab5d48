"""Floor plans under the name of the database that the original megastep took its own from:
``cubicasa.sample(64)``.

CubiCasa5k's licence (CC BY-NC) keeps it out of this package. These are the homes of
:mod:`megastep.geometries.homes` instead: as many, and generated to have the statistics measured on
it.
"""

from megastep.dotdict import dotdict
from megastep.geometries import sample as _sample

__all__ = ["sample"]


def sample(n_geometries: int, split: str = "training", seed: int = 1) -> list[dotdict]:
    """``n_geometries`` homes, a list of geometries. ``split`` is training, test or all."""
    return _sample("homes", n_geometries, split, seed)
