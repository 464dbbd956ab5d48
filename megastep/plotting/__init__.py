"""Pictures of environments: floor plans, agents and what they see.

All functions take numpy arrays in metres, degrees and linear light, as a numpyified
``env.state(e)`` holds them; none needs a GPU. :func:`panels` makes a picture for ``plot_state``:
fast enough for films, and shown by notebooks. Its areas, and matplotlib's axes, are what the other
functions draw on. :func:`styled` changes theme, size and title of what is made inside it.

A agents, C channels, H rows and W columns, L lines, K lights, R rays.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from megastep.colour import *  # noqa: F403
    from megastep.plotting.marks import *  # noqa: F403
    from megastep.plotting.pictures import *  # noqa: F403
    from megastep.plotting.plans import *  # noqa: F403
    from megastep.plotting.styles import *  # noqa: F403

_MODULES = {
    "megastep.colour": "gamma_decode gamma_encode",
    "megastep.plotting.styles": "AGENTS Style current styled",
    "megastep.plotting.marks": "STRIP camera_colours plot_agent plot_goal plot_hold plot_images "
    "plot_object plot_shot plot_trail plot_view view_polygon",
    "megastep.plotting.plans": "plot_scenery wall_colours",
    "megastep.plotting.pictures": "Area Picture captioned encoded framed panels plot_level "
    "rasterise side_by_side",
}
_NAMES = {name: module for module, names in _MODULES.items() for name in names.split()}
__all__ = sorted(_NAMES)


def __getattr__(name: str) -> Any:
    """Imports a module when it is first used: those that need matplotlib take half a second."""
    if name not in _NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_NAMES[name]), name)
