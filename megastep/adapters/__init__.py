"""megastep's environments in other libraries.

Each adapter is imported at its first use, and needs the extra of its name, such as
``pip install 'megastep-flatland[sb3]'``. Importing this package registers the environments with
Gymnasium, if it is installed.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING

from megastep.envs import ENVS

if TYPE_CHECKING:
    from megastep.adapters.parallel_env import ParallelEnv as ParallelEnv
    from megastep.adapters.rsl_rl import RslRlVecEnv as RslRlVecEnv
    from megastep.adapters.sb3 import SB3VecEnv as SB3VecEnv
    from megastep.adapters.torchrl import TorchRLEnv as TorchRLEnv
    from megastep.adapters.vector_env import SingleEnv as SingleEnv
    from megastep.adapters.vector_env import VectorEnv as VectorEnv

#: The module and the extra of each name; extras with hyphens: older pips find no other.
_MODULES = {
    "SingleEnv": ("vector_env", "gymnasium"),
    "VectorEnv": ("vector_env", "gymnasium"),
    "ParallelEnv": ("parallel_env", "pettingzoo"),
    "RslRlVecEnv": ("rsl_rl", "rsl-rl"),
    "SB3VecEnv": ("sb3", "sb3"),
    "TorchRLEnv": ("torchrl", "torchrl"),
}
#: The environments by their ids in Gymnasium; those of other packages have ids already.
IDS = {
    f"megastep/{kind.__name__}-v0": kind.__name__
    for kind in ENVS.values()
    if getattr(kind, "capturable", True)
}


def __getattr__(name) -> object:
    if name not in _MODULES:
        raise AttributeError(f"megastep.adapters has no {name}; it has {', '.join(_MODULES)}")
    module, extra = _MODULES[name]
    try:
        return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("megastep"):
            raise
        raise ImportError(
            f"megastep.adapters.{name} needs {error.name}, which is not installed: pip install "
            f"'megastep-flatland[{extra}]'"
        ) from None


__all__ = []
if importlib.util.find_spec("gymnasium"):
    import gymnasium

    __all__ += ["SingleEnv", "VectorEnv"]
    for _id, _name in IDS.items():
        if _id not in gymnasium.registry:
            gymnasium.register(
                _id,
                entry_point="megastep.adapters.vector_env:make_single",
                vector_entry_point="megastep.adapters.vector_env:make_vector",
                kwargs=dict(name=_name),
            )
