"""The environments. ``ENVS`` holds their classes by the names of their modules, which are imported
at their first use.
"""

import importlib
import pkgutil
from collections.abc import Iterator, Mapping

_SHARED = ("common", "first_person")  # modules that hold no environment


class _Envs(Mapping[str, type]):
    """A module's environment is the first of its ``__all__``, its own name but for capitals."""

    names = [file.name for file in pkgutil.iter_modules(__path__) if file.name not in _SHARED]

    def __getitem__(self, name: str) -> type:
        if name not in self.names:
            raise KeyError(name)
        module = importlib.import_module(f"{__name__}.{name}")
        return getattr(module, module.__all__[0])

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


#: The environments by module name.
ENVS = _Envs()


def __getattr__(name) -> object:
    if name == "__all__":
        return __dir__()
    if name in _SHARED or name in ENVS:
        return importlib.import_module(f"{__name__}.{name}")
    if name.lower() in ENVS and (env := ENVS[name.lower()]).__name__ == name:
        return env
    raise AttributeError(f"megastep.envs has no {name}; its modules: {', '.join(ENVS)}")


def __dir__() -> list[str]:
    return ["ENVS", *sorted(env.__name__ for env in ENVS.values())]
