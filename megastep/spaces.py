"""Spaces: what observations and actions look like. A space, or a dotdict of spaces, says which
numbers to expect.

A space's ``shape`` is that of one lane, without the leading axis B. Heads turn spaces into network
layers.
"""

from dataclasses import astuple, dataclass, fields

__all__ = ["MultiDiscrete", "MultiEmpty", "MultiImage", "MultiVector"]


class _Space:
    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(
                    f"{type(self).__name__} needs a positive integer for {field.name}, not "
                    f"{value!r}"
                )


@dataclass(frozen=True)
class MultiVector(_Space):
    """A vector of ``dim`` numbers for every agent: shape (n_agents, dim)."""

    n_agents: int
    dim: int

    @property
    def shape(self) -> tuple[int, ...]:
        return astuple(self)


@dataclass(frozen=True)
class MultiImage(_Space):
    """An image of C channels, H rows and W columns for every agent: shape (n_agents, C, H, W)."""

    n_agents: int
    C: int
    H: int
    W: int

    @property
    def shape(self) -> tuple[int, ...]:
        return astuple(self)


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
