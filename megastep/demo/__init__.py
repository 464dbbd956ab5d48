"""The original's `megastep.demo`, as another name of what replaced it."""

import importlib
import sys
import warnings

#: Places of the original's modules and names.
_MODULES = {
    "envs": "megastep.envs",
    "envs.minimal": "megastep.envs.minimal",
    "envs.explorer": "megastep.envs.explorer",
    "envs.deathmatch": "megastep.envs.deathmatch",
    "envs.waypoint": "megastep.envs.pointgoal",
    "heads": "megastep.agents.networks.heads",
    "learning": "megastep.agents.algorithms.returns",
    "lstm": "megastep.agents.networks.lstm",
}
_NAMES = {
    "Agent": "megastep.agents.networks.policy:Policy",
    "demo": "megastep.agents.api:record",
    "train": "megastep.agents.api:train",
}

warnings.warn(
    "megastep.demo is megastep.envs and megastep.agents; docs/from-the-original.md has the new "
    "place of each name",
    DeprecationWarning,
    stacklevel=2,
)
for _name, _place in _MODULES.items():
    sys.modules[f"{__name__}.{_name}"] = importlib.import_module(_place)
    if "." not in _name:
        globals()[_name] = sys.modules[_place]


def __getattr__(name) -> object:
    if name in _NAMES:
        module, _, attribute = _NAMES[name].partition(":")
        return getattr(importlib.import_module(module), attribute)
    raise AttributeError(f"megastep.demo has no {name}; it has {', '.join({**_MODULES, **_NAMES})}")
