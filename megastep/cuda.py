"""The engine under its historical name: everything in :mod:`megastep.engine`, and
:class:`~megastep.core.Core`.

Tutorials use this name. It needs no GPU: operations run on the device of their tensors.
"""

from typing import Any

from megastep import engine
from megastep.core import Core


def __getattr__(name) -> Any:
    return getattr(engine, name)


def __dir__() -> list[str]:
    return sorted({*dir(engine), "Core"})


__all__ = [*engine.__all__, "Core"]
