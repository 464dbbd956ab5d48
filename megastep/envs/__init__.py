"""The environments. ``ENVS`` has the classes by the names of their modules."""

import importlib
import pkgutil

#: The environments' classes by module: the first name in the module's ``__all__``.
ENVS = {}
for _file in pkgutil.iter_modules(__path__):
    _module = importlib.import_module(f"{__name__}.{_file.name}")
    ENVS[_file.name] = getattr(_module, _module.__all__[0])
globals().update({_env.__name__: _env for _env in ENVS.values()})

__all__ = ["ENVS", *sorted(_env.__name__ for _env in ENVS.values())]
