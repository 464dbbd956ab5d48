"""The environments. ``ENVS`` holds their classes by the names of their modules, which are imported
at their first use.
"""

import importlib
import pkgutil
from collections.abc import Iterator, Mapping

_SHARED = ("common", "first_person")  # modules that hold no environment
_NAMES = [file.name for file in pkgutil.iter_modules(__path__) if file.name not in _SHARED]


class _Envs(Mapping[str, type]):
    """A module's environment is the first of its ``__all__``: CartPole of ``cart_pole``."""

    def __getitem__(self, name: str) -> type:
        if name not in _NAMES:
            raise KeyError(name)
        module = importlib.import_module(f"{__name__}.{name}")
        return getattr(module, module.__all__[0])

    def __iter__(self) -> Iterator[str]:
        return iter(_NAMES)

    def __len__(self) -> int:
        return len(_NAMES)


#: The environments by module name.
ENVS = _Envs()


def __getattr__(name) -> object:
    if name == "__all__":
        return ["ENVS", *sorted(env.__name__ for env in ENVS.values())]
    modules = {module.replace("_", ""): module for module in _NAMES}
    if name.lower().replace("_", "") not in modules:
        raise AttributeError(f"megastep.envs has no {name}; its modules: {', '.join(_NAMES)}")
    module = modules[name.lower().replace("_", "")]
    found = importlib.import_module(f"{__name__}.{module}")
    return found if name == module else getattr(found, name)
