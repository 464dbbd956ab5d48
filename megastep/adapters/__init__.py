"""megastep's environments in other libraries, and a checker of vector environments.

Each adapter is imported at its first use, and needs the extra of its name, such as
``pip install 'megastep-flatland[sb3]'``. Importing this package registers the environments with
Gymnasium, if it is installed.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from megastep.adapters.gymnasium import SingleEnv as SingleEnv
    from megastep.adapters.gymnasium import VectorEnv as VectorEnv
    from megastep.adapters.pettingzoo import ParallelEnv as ParallelEnv
    from megastep.adapters.rsl_rl import RslRlVecEnv as RslRlVecEnv
    from megastep.adapters.sb3 import SB3VecEnv as SB3VecEnv
    from megastep.adapters.torchrl import TorchRLEnv as TorchRLEnv
    from megastep.adapters.vector_checks import check_vector_env as check_vector_env

#: The module of each name, which is its extra too, with hyphens: older pips find no other.
_MODULES = {
    "SingleEnv": "gymnasium",
    "VectorEnv": "gymnasium",
    "ParallelEnv": "pettingzoo",
    "RslRlVecEnv": "rsl_rl",
    "SB3VecEnv": "sb3",
    "TorchRLEnv": "torchrl",
    "check_vector_env": "vector_checks",
}


def __getattr__(name) -> object:
    if name not in _MODULES:
        raise AttributeError(f"megastep.adapters has no {name}; it has {', '.join(_MODULES)}")
    module = _MODULES[name]
    try:
        return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("megastep"):
            raise
        extra = "gymnasium" if module == "vector_checks" else module.replace("_", "-")
        raise ImportError(
            f"megastep.adapters.{name} needs {error.name}, which is not installed: pip install "
            f"'megastep-flatland[{extra}]'"
        ) from None


__all__ = []
if importlib.util.find_spec("gymnasium"):
    __all__ += ["SingleEnv", "VectorEnv", "check_vector_env"]
    from megastep.adapters.registration import register

    register()
