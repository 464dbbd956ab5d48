"""megastep: reinforcement learning in thousands of small 2D environments on one device.

Importing the package loads nothing else. Its modules, and the functions of `agents.api`, are
imported at their first use::

    import megastep

    env = megastep.make("explorer", n_envs=64, geometry="homes")
    run = megastep.train(env="explorer", seconds=60)
    megastep.toys.box()

Import it before torch: OpenMP reads how its threads wait when it is loaded. Threads that spin while
they wait for others take the cores that those others need, wherever anything else runs: with one of
two cores taken, training was 100 times slower. Asleep, they lose a few microseconds per wait.
"""

import importlib
import os
import pkgutil
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import ModuleType

    from megastep.agents.api import Run as Run
    from megastep.agents.api import evaluate as evaluate
    from megastep.agents.api import load as load
    from megastep.agents.api import make as make
    from megastep.agents.api import record as record
    from megastep.agents.api import runs as runs
    from megastep.agents.api import save as save
    from megastep.agents.api import train as train
    from megastep.agents.errors import UserError as UserError

if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")

#: What the package has from its modules, which are imported at their first use too.
_NAMES = {
    **dict.fromkeys(
        ("Run", "evaluate", "load", "make", "record", "runs", "save", "train"), "agents.api"
    ),
    "UserError": "agents.errors",
}
_MODULES = [module.name for module in pkgutil.iter_modules(__path__) if module.name[0] != "_"]


def __getattr__(name) -> "ModuleType":
    if name in _NAMES:
        return getattr(importlib.import_module(f"{__name__}.{_NAMES[name]}"), name)
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"megastep has no module '{name}'; its modules: {', '.join(_MODULES)}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES, *_NAMES})
