"""Settings that change while training: numbers, and schedules of them.

A schedule is `{from: 0.02, to: 0.001}`, which changes linearly over the budget of a run, or a
function of the fraction of the budget that is spent, from 0 to 1, by import path or itself. This
module does without PyTorch.
"""

import dataclasses
import math
import numbers
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, cast

import annotated_types
from pydantic_core import core_schema

from megastep.imports import import_object

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler

__all__ = ["Number", "Scheduled", "called", "schedule_of"]

#: A number or a schedule.
Number = float | Mapping[str, float] | str | Callable[[float], float]
_ENDS = {"from", "to"}
#: Fractions of the budget at which a function is tried.
_TRIED = 0.0, 0.5, 1.0


@dataclasses.dataclass(frozen=True)
class Scheduled(annotated_types.BaseMetadata):
    """Metadata of an annotation: the setting is a number within bounds, or a schedule of such,
    which may end at an exclusive bound, as one that falls to 0 does.
    """

    ge: float | None = None
    gt: float | None = None
    le: float | None = None

    def __get_pydantic_core_schema__(
        self, source: type, handler: "GetCoreSchemaHandler"
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)

    def check(self, value: object) -> object:
        """Returns a setting, with numbers as floats. Raises ValueError for what is neither."""
        if isinstance(value, numbers.Real) and not isinstance(value, bool):
            return self._bounded(value)
        if isinstance(value, Mapping) and value.keys() == _ENDS:
            return {name: self._bounded(value[name], True) for name in ("from", "to")}
        if callable(value) or (isinstance(value, str) and ":" in value):
            function = schedule_of(cast(Number, value))
            if not callable(function):
                raise ValueError(f"{value} is no function of the fraction of the budget")
            for fraction in _TRIED:
                self._bounded(called(function, fraction), True)
            return value
        raise ValueError(
            f"expected a number, got {value!r}; a schedule is {{from: 1, to: 0.1}} or "
            "module:function"
        )

    def _bounded(self, value, of_schedule=False) -> float:
        if not isinstance(value, numbers.Real) or isinstance(value, bool):
            raise ValueError(f"expected a number, got {value!r}")
        number, is_open = float(value), self.gt is not None and not of_schedule
        low = self.ge if self.gt is None else self.gt
        low = -math.inf if low is None else low
        is_inside = low <= number <= (math.inf if self.le is None else self.le)
        if not is_inside or not math.isfinite(number) or (is_open and number == low):
            lower = f"above {low:,}" if is_open else f"from {low:,}"
            raise ValueError(f"{value} is out of range: allowed is {lower} to {self.le:,}")
        return number


def schedule_of(value: Number | None) -> Callable[[float], float] | None:
    """Returns a setting as a function of the fraction of the budget; None for a constant."""
    if isinstance(value, Mapping):
        first, last = value["from"], value["to"]
        return lambda fraction: first * (1 - fraction) + last * fraction
    if isinstance(value, str):
        return import_object(value)
    return value if callable(value) else None


def called(function: Callable[[float], float], fraction: float) -> float:
    """Returns what a schedule gives at a fraction. Raises ValueError with its error."""
    try:
        return function(fraction)
    except Exception as error:
        name = getattr(function, "__qualname__", function)
        raise ValueError(f"{name}({fraction:g}) failed ({type(error).__name__}: {error})") from None
