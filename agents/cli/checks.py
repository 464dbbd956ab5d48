"""Dataclass fields that know which values they allow. A check returns a sentence, or None."""

import dataclasses
import math
import re
from collections.abc import Callable
from typing import Any

from agents.cli.errors import closest
from megastep.bounds import Within


def _field(check: Callable[[Any], str | None]) -> Any:
    return dataclasses.field(metadata={"check": check})


def within(min: float, max: float, min_open: bool = False, max_open: bool = False) -> Any:
    """A finite number between two limits, which belong to it unless open."""
    return _field(Within(min, max, min_open, max_open).error)


def bounded_by(bounds: Within | None, default: Any) -> Any:
    """A value of an argument with these bounds and this default."""
    check = bounds.error if bounds else lambda value: None
    return dataclasses.field(default=default, metadata={"check": check})


def above(min: float) -> Any:
    """A finite number larger than `min`."""
    return within(min, math.inf, min_open=True)


def among(*names: str) -> Any:
    """One of these words."""

    def check(value: str) -> str | None:
        return None if value in names else f"{value!r} is unknown; {closest(value, names)}"

    return _field(check)


def device_name() -> Any:
    """auto, cpu, cuda or cuda:<number>."""

    def check(value: str) -> str | None:
        if re.fullmatch(r"auto|cpu|cuda(:\d+)?", value):
            return None
        return f"{value!r} is no device: allowed are auto, cpu, cuda and cuda:<number>"

    return _field(check)
