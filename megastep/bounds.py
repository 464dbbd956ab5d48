"""Which values an argument allows, said once: in the annotations of a constructor.

::

    @bounded
    def __init__(self, n_envs: Annotated[int, Within(1, MAX_ENVS)] = 128): ...
"""

import dataclasses
import functools
import inspect
import math
import typing
from collections.abc import Callable

__all__ = ["MAX_ENVS", "Within", "bounded"]

#: 2**26 copies of the smallest environment fill the largest accelerator there is; more is a typing
#: mistake.
MAX_ENVS = 2**26


@dataclasses.dataclass(frozen=True)
class Within:
    """A finite number between two limits, which belong to it unless open."""

    min: float
    max: float = math.inf
    min_open: bool = False
    max_open: bool = False

    def error(self, value: float) -> str | None:
        """The sentence for a value that is not allowed, or None."""
        above_min = self.min < value if self.min_open else self.min <= value
        below_max = value < self.max if self.max_open else value <= self.max
        if above_min and below_max and math.isfinite(value):  # nan compares false
            return None
        return f"{value} is out of range: allowed is {self}"

    def __str__(self):
        if self.max == math.inf:
            return f"{'more than' if self.min_open else 'at least'} {self.min:,}"
        last = "and below" if self.max_open else "to"
        return f"{'above' if self.min_open else 'from'} {self.min:,} {last} {self.max:,}"


def bounds_of(function: Callable) -> dict[str, Within]:
    """The bounds in a function's annotations, by argument."""
    hints = typing.get_type_hints(function, include_extras=True)
    return {
        name: extra
        for name, hint in hints.items()
        for extra in getattr(hint, "__metadata__", ())
        if isinstance(extra, Within)
    }


def bounded(function: Callable) -> Callable:
    """The function, which raises ValueError by name for arguments out of their bounds."""
    signature, bounds = inspect.signature(function), bounds_of(function)

    @functools.wraps(function)
    def checked(*args, **kwargs):
        given = signature.bind(*args, **kwargs).arguments
        for name in given.keys() & bounds.keys():
            if sentence := bounds[name].error(given[name]):
                raise ValueError(f"{name}: {sentence}")
        return function(*args, **kwargs)

    return checked
