"""The environments: one file, one environment. ``ENVS`` names them after their files."""

import importlib
import pkgutil

#: By the name of its file, the class that the file's ``__all__`` names.
ENVS = {}
for _file in pkgutil.iter_modules(__path__):
    _module = importlib.import_module(f"{__name__}.{_file.name}")
    ENVS[_file.name] = getattr(_module, _module.__all__[0])
globals().update({_env.__name__: _env for _env in ENVS.values()})

__all__ = ["ENVS", *sorted(_env.__name__ for _env in ENVS.values())]
