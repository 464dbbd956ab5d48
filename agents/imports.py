"""Classes and functions by import path, `module:attribute`, from wherever Python finds them."""

import importlib
import os
import sys
from collections.abc import Callable
from typing import Any

from megastep.settings import closest


def import_object(name: str) -> Callable:
    """The class or function called `module:attribute`; the current folder is searched, too.
    ValueError, one sentence, if there is none.
    """
    module, _, attribute = name.partition(":")
    if not (module and attribute):
        raise ValueError(f"{name!r} is no import path, such as my_package.rover:Rover")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        found: Any = importlib.import_module(module)
    except Exception as error:  # whatever a module does as it is imported
        reason = (str(error).splitlines() or [""])[0]
        kind = "" if isinstance(error, ModuleNotFoundError) else f"{type(error).__name__}: "
        raise ValueError(f"{name} cannot be imported ({kind}{reason})") from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            near = closest(part, [word for word in dir(found) if not word.startswith("_")])
            raise ValueError(f"{name} cannot be imported: {module} has no {part}; {near}")
        found = getattr(found, part)
    if not callable(found):
        raise ValueError(f"{name} is a {type(found).__name__}, neither a class nor a function")
    return found


def resolve(name: str, table: dict[str, Any]) -> Callable:
    """What `name` stands for: a word of the table, or an import path. ValueError, one sentence, if
    it is neither.
    """
    if name in table:
        return table[name]
    if ":" in name:
        return import_object(name)
    raise ValueError(f"{name!r} is unknown; {closest(name, [*table, 'module:Class'])}")
