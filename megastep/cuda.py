"""The engine under its historical name: everything in :mod:`megastep.engine`, and
:class:`~megastep.core.Core`.

Tutorials use this name. It needs no GPU: operations run on the device of their tensors.
"""

from megastep import engine
from megastep.core import Core
from megastep.engine import *  # noqa: F403

__all__ = [*engine.__all__, "Core"]
