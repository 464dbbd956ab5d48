"""Imports classes and functions by path: `module:attribute`."""

import importlib
import os
import sys
from collections.abc import Callable
from typing import Any

from megastep.settings import closest


def import_object(name: str) -> Callable:
    """Returns the class or function at `module:attribute`. Also searches the current folder.

    Raises:
        ValueError: if it cannot be imported, in one sentence.
    """
    module, _, attribute = name.partition(":")
    if not (module and attribute):
        raise ValueError(f"{name!r} is no import path, such as my_package.rover:Rover")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        imported: Any = importlib.import_module(module)
    except Exception as error:  # whatever a module does as it is imported
        reason = (str(error).splitlines() or [""])[0]
        kind = "" if isinstance(error, ModuleNotFoundError) else f"{type(error).__name__}: "
        raise ValueError(f"{name} cannot be imported ({kind}{reason})") from error
    for part in attribute.split("."):
        if not hasattr(imported, part):
            near = closest(part, [word for word in dir(imported) if not word.startswith("_")])
            raise ValueError(f"{name} cannot be imported: {module} has no {part}; {near}")
        imported = getattr(imported, part)
    if not callable(imported):
        raise ValueError(f"{name} is a {type(imported).__name__}, neither a class nor a function")
    return imported


def resolve(name: str, table: dict[str, Any]) -> Callable:
    """Returns the entry of `table` called `name`, or the class or function at this import path.

    Raises:
        ValueError: if it is neither, in one sentence.
    """
    if name in table:
        return table[name]
    if ":" in name:
        return import_object(name)
    raise ValueError(f"{name!r} is unknown; {closest(name, [*table, 'module:Class'])}")
