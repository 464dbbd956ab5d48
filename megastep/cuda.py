"""The engine under the name that tutorials use: everything in :mod:`megastep.engine`, and
:class:`~megastep.core.Core`.

The name is historical. The tensors' device decides where the work is done, so this runs without a
GPU too.
"""

from megastep import engine
from megastep.core import Core


def __getattr__(name):
    return getattr(engine, name)


def __dir__():
    return sorted({*dir(engine), "Core"})


__all__ = [*engine.__all__, "Core"]
