"""Imports classes and functions by path: `module:attribute`."""

import importlib
import inspect
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePath
from typing import Any

from megastep.settings import closest


def import_object(name: str) -> Callable:
    """Returns the class or function at `module:attribute`. Raises ValueError if it cannot be
    imported. For what is in megastep, the current folder is not searched: it may hold anything.
    """
    module, _, attribute = name.partition(":")
    if not all(part.isidentifier() for part in [*module.split("."), *attribute.split(".")]):
        raise ValueError(f"{name!r} is not an import path, such as my_package.rover:Rover")
    if module.partition(".")[0] != "megastep":
        search_current_folder()
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


def import_path(thing: object) -> str:
    """Returns `module:Class` of a class or function; a name as it is. ValueError for local ones."""
    if isinstance(thing, str):
        return thing
    name = getattr(thing, "__qualname__", "<")
    if "<" in name:
        raise ValueError(f"{name} has no import path; define it at the top of a module")
    return f"{thing.__module__}:{name}"


def search_current_folder() -> None:
    """Adds the current folder to `sys.path`: before installed packages, so that none shadows the
    user's modules, and after the standard library, so that a `random.py` breaks nothing.
    """
    here = os.getcwd()
    if here not in sys.path:
        installed = [PurePath(path).name in ("site-packages", "dist-packages") for path in sys.path]
        sys.path.insert([*installed, True].index(True), here)


def resolve(name: str, table: Mapping[str, str], base: type) -> type:
    """Returns the class at the import path `name`, or at that of this name in `table`. Raises
    ValueError if it is neither, or no class derived from `base` that takes one argument.
    """
    known_name(name, [*table])
    imported = import_object(table.get(name, name))
    if not (isinstance(imported, type) and issubclass(imported, base)):
        package = base.__module__.partition(".")[0]
        raise ValueError(f"{name} must be a class derived from {package}'s {base.__name__}")
    try:
        inspect.signature(imported).bind(None)
    except TypeError as error:
        raise ValueError(f"{name} must take one argument ({error})") from None
    return imported


def known_name(name: str | type, names: Sequence[str]) -> str:
    """Returns a name in `names`, or the import path of a class. Raises ValueError for others."""
    name = import_path(name)
    if name not in names:
        if ":" not in name:
            raise ValueError(f"{name!r} is unknown; {closest(name, [*names, 'module:Class'])}")
        import_object(name)
    return name
