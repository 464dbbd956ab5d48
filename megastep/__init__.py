"""megastep: reinforcement learning in thousands of small flat environments on one device.

Importing the package loads nothing else. Its modules arrive when they are first used, either way
round::

    from megastep import toys, scene, cuda
    import megastep; megastep.toys.box()
"""

import importlib

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


def __getattr__(name):
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"megastep has no module '{name}'; its modules are {', '.join(_MODULES)}")


def __dir__():
    return sorted({*globals(), *_MODULES})
