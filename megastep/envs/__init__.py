"""The environments. ``ENVS`` holds their classes by the names of their modules."""

import importlib
import pkgutil

_SHARED = ("common", "first_person")  # modules that hold no environment

#: The environments by module name. A module's environment is the first name in its ``__all__``.
ENVS = {}
for _file in pkgutil.iter_modules(__path__):
    if _file.name not in _SHARED:
        _module = importlib.import_module(f"{__name__}.{_file.name}")
        ENVS[_file.name] = getattr(_module, _module.__all__[0])
globals().update({_env.__name__: _env for _env in ENVS.values()})

__all__ = ["ENVS", *sorted(_env.__name__ for _env in ENVS.values())]
