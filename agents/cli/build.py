"""Settings from nested dicts, checked in one pass: `build(Train, tree)`. Knows no Hydra."""

import dataclasses
import types
import typing
from typing import Any

from agents.cli.errors import ConfigErrors, closest
from agents.cli.settings import VARIANTS

#: What a value of each type is called in an error.
WANTED = {int: "an integer", float: "a number", bool: "true or false", str: "a word"}

Errors = list[tuple[str, str]]


def build(kind: type, tree: dict[str, Any]) -> Any:
    """The settings of dataclass `kind` from nested dicts; raises `ConfigErrors` with all that is
    wrong, not the first.
    """
    errors: Errors = []
    settings = _settings(kind, tree, "", errors)
    if errors:
        raise ConfigErrors(errors)
    return settings


def as_tree(settings: Any) -> dict[str, Any]:
    """Nested plain dicts, the inverse of `build`."""
    return dataclasses.asdict(settings)


def _settings(kind: type, tree: dict[str, Any], path: str, errors: Errors) -> Any:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    hints = typing.get_type_hints(kind)
    before, values = len(errors), {}
    for key in tree:
        if key not in fields:
            errors.append((path + key, f"no such key; {closest(key, fields)}"))
    for name, field in fields.items():
        options, optional = _options(hints[name])
        if name in tree:
            values[name] = _value(options, optional, tree[name], path + name, errors)
        elif optional and dataclasses.is_dataclass(options[0]):  # a group that was not chosen
            values[name] = None
        else:
            errors.append((path + name, "is missing"))
            continue
        check = field.metadata.get("check")
        if check and values[name] is not None and (sentence := check(values[name])):
            errors.append((path + name, sentence))
    if len(errors) > before:
        return None
    settings = kind(**values)
    if hasattr(settings, "errors"):  # what concerns two settings at once
        errors += [(path + name, sentence) for name, sentence in settings.errors()]
    return settings


def _options(hint: Any) -> tuple[list[type], bool]:
    """The types that a hint allows beside None, and whether it allows None."""
    options = list(typing.get_args(hint)) or [hint]
    return [o for o in options if o is not types.NoneType], types.NoneType in options


def _value(options: list[type], optional: bool, value: Any, path: str, errors: Errors) -> Any:
    if value is None and optional:
        return None
    if dataclasses.is_dataclass(options[0]):
        if isinstance(value, dict):
            return _settings(_variant(options, value, path, errors), value, path + ".", errors)
        errors.append((path, f"is a group of keys, got {value!r}"))
        return None
    (kind,) = options
    if isinstance(value, kind) and (kind is bool or not isinstance(value, bool)):
        return value
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)  # samples=1e6
    got = "nothing" if value is None else repr(value)
    errors.append((path, f"expected {WANTED[kind]}, got {got}"))
    return None


def _variant(options: list[type], value: dict[str, Any], path: str, errors: Errors) -> type:
    """The dataclass among `options` that the group's `name` chooses."""
    if len(options) == 1:
        return options[0]
    (variants,) = (table for table in VARIANTS if options[0] in table.values())
    name = value.get("name")
    if name not in variants:
        errors.append((f"{path}.name", f"{name!r} is unknown; {closest(name, variants)}"))
        return options[0]
    return variants[name]
