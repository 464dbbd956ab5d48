"""Makes the objects of a run from plain settings: device, homes, environment, policy, learner.

`factory.homes` and so on are the functions of `make`, which is imported at their first use: it
needs PyTorch, without which settings are checked.
"""

import importlib
from typing import Any

_MODULES = "check", "components", "conflicts", "env_failures", "make", "settings", "trainer"


def __getattr__(name) -> Any:
    if name in _MODULES or name.startswith("_"):
        raise AttributeError(f"module {__name__} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.make"), name)
