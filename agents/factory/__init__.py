"""Makes the objects of a run from plain settings: device, homes, environment, policy, learner.

    from megastep.agents import factory

    device = factory.make_device("auto")

The functions need PyTorch, so they are imported at their first use: settings are checked without
it.
"""

import importlib
from typing import Any

_FUNCTIONS = (
    "check_memory",
    "config_of",
    "construct",
    "errors",
    "homes",
    "in_env",
    "layout_sources",
    "make_bot",
    "make_device",
    "make_learner",
    "make_opponents",
    "make_policy",
    "make_sample",
    "share_threads",
    "sources_of",
    "spread",
    "typed_or",
)


def __getattr__(name) -> Any:
    if name in _FUNCTIONS:
        return getattr(importlib.import_module(f"{__name__}.make"), name)
    raise AttributeError(f"module {__name__} has no attribute {name!r}")
