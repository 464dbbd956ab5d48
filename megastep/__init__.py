"""megastep: reinforcement learning in thousands of small 2D environments on one device.

Importing the package loads nothing else. Its modules are imported at their first use::

    from megastep import toys, scene, cuda
    import megastep; megastep.toys.box()
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import ModuleType

_MODULES = (
    "agents",
    "arrdict",
    "capture",
    "contract",
    "core",
    "cubicasa",
    "cuda",
    "dotdict",
    "engine",
    "envs",
    "geometries",
    "geometry",
    "kernels",
    "modules",
    "plotting",
    "ragged",
    "recording",
    "scene",
    "spaces",
    "toys",
    "types",
)


def __getattr__(name) -> "ModuleType":
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"megastep has no module '{name}'; its modules are {', '.join(_MODULES)}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
