"""Spaces: what observations and actions look like. A space, or a dotdict of spaces, says which
numbers to expect.

A space's ``shape`` is that of one lane, without the leading axis B. Heads turn spaces into network
layers. A vector or an image may name its ``dtype``, in which it is given and stored:
``MultiImage(1, 3, 1, 64, dtype=torch.uint8)``. Without one, any float will do.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import torch

from megastep.arrdict import arrdict

__all__ = ["MultiDiscrete", "MultiEmpty", "MultiImage", "MultiVector", "leaves", "map"]


DTYPES = torch.uint8, torch.float16, torch.float32


class _Space:
    def __post_init__(self):
        for name, value in self._sizes().items():
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(
                    f"{type(self).__name__} needs a positive integer for {name}, not {value!r}"
                )

    def _sizes(self):
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "dtype"}

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self._sizes().values())


@dataclass(frozen=True)
class _Numbers(_Space):
    dtype: torch.dtype | None = field(default=None, kw_only=True)

    def __post_init__(self):
        super().__post_init__()
        if self.dtype not in (None, *DTYPES):
            raise ValueError(
                f"{type(self).__name__} can be of dtype {', '.join(map(str, DTYPES))}, not "
                f"{self.dtype!r}"
            )

    def __repr__(self):
        # a dtype only where it is named: checkpoints compare spaces as text
        named = {**self._sizes(), **({"dtype": self.dtype} if self.dtype else {})}
        values = ", ".join(f"{name}={value!r}" for name, value in named.items())
        return f"{type(self).__name__}({values})"


@dataclass(frozen=True, repr=False)
class MultiVector(_Numbers):
    """A vector of ``dim`` numbers for every agent: shape (n_agents, dim)."""

    n_agents: int
    dim: int


@dataclass(frozen=True, repr=False)
class MultiImage(_Numbers):
    """An image of C channels, H rows and W columns for every agent: shape (n_agents, C, H, W)."""

    n_agents: int
    C: int
    H: int
    W: int


@dataclass(frozen=True)
class MultiDiscrete(_Space):
    """An integer from 0 to ``n_actions`` - 1 for every agent: shape (n_agents,)."""

    n_agents: int
    n_actions: int

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.n_agents,)


@dataclass(frozen=True)
class MultiEmpty(_Space):
    """Nothing at all: shape (0,)."""

    @property
    def shape(self) -> tuple[int, ...]:
        return (0,)


def leaves(space: Any, name: str = "") -> dict[str, Any]:
    """Returns the leaf spaces of a tree of spaces by dotted path, such as ``{"obs.rgb": ...}``.

    ``name`` is the path of the tree itself. A space that is no dict is its own only leaf.
    """
    if not isinstance(space, Mapping):
        return {name: space}
    paths = {}
    for key, child in space.items():
        paths |= leaves(child, f"{name}.{key}" if name else key)
    return paths


def map(function: Callable, space: Any, *trees: Any) -> Any:
    """Returns ``function(leaf_space, *leaf_values)`` for each leaf, as an arrdict with the keys of
    the space; for a space that is no dict, the function's result itself.

    ``trees`` are dicts with the same keys as the space, such as observations or actions. KeyError
    if a key is missing from one.
    """
    if not isinstance(space, Mapping):
        return function(space, *trees)
    return arrdict(
        {
            key: map(function, child, *(tree[key] for tree in trees))
            for key, child in space.items()
        }
    )
