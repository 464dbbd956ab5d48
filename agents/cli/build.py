"""Settings from nested dicts, checked in one pass: `build(Train, tree)`. Knows no Hydra."""

import dataclasses
import types
import typing
from collections.abc import Iterable, Iterator
from typing import Any

from agents.cli.errors import ConfigErrors, closest, closest_key
from agents.cli.settings import VARIANTS

#: What a value of each type is called in an error.
WANTED = {int: "an integer", float: "a number", bool: "true or false", str: "a word"}

Errors = list[tuple[str, str]]


def build(kind: type, tree: dict[str, Any], choices: Iterable[str] = ()) -> Any:
    """The settings of dataclass `kind` from nested dicts; raises `ConfigErrors` with all that is
    wrong, not the first. `choices` are names that may have been meant beside those of keys.
    """
    errors: Errors = []
    settings = _settings(kind, tree, "", errors)
    if errors:
        known = [*_keys(kind, tree), *choices]
        raise ConfigErrors(
            (path, sentence or f"no such key; {closest_key(path, known)}")
            for path, sentence in errors
        )
    return settings


def as_tree(settings: Any) -> dict[str, Any]:
    """Nested plain dicts, the inverse of `build`."""
    return dataclasses.asdict(settings)


def _settings(kind: type, tree: dict[str, Any], path: str, errors: Errors) -> Any:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    hints = typing.get_type_hints(kind)
    before, values = len(errors), {}
    errors += [(path + key, _of_another(kind, key, path)) for key in tree if key not in fields]
    for name, field in fields.items():
        options, optional = _options(hints[name])
        if name in tree:
            values[name] = _value(options, optional, tree[name], path + name, errors)
        elif optional and dataclasses.is_dataclass(options[0]):  # a group that was not chosen
            values[name] = None
        elif field.default is not dataclasses.MISSING:
            continue
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
        if not isinstance(value, dict):
            errors.append((path, f"is a group of keys, got {value!r}"))
            return None
        variants = _variants(options[0])
        if variants and value.get("name") not in variants:
            name = value.get("name")
            errors.append((f"{path}.name", f"{name!r} is unknown; {closest(name, variants)}"))
        return _settings(_variant(options, value), value, path + ".", errors)
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


# ---- Groups whose member decides which keys there are ----


def _variants(kind: type) -> dict[str, type]:
    """All members of the group that a dataclass is one of, by name; empty if it is of none."""
    return next((table for table in VARIANTS if kind in table.values()), {})


def _variant(options: list[type], value: dict[str, Any]) -> type:
    """The dataclass that the group's `name` chooses."""
    return _variants(options[0]).get(value.get("name"), options[0])


def _of_another(kind: type, key: str, path: str) -> str:
    """The sentence for a key that another member of the group has, or none."""
    for name, other in _variants(kind).items():
        if key in (field.name for field in dataclasses.fields(other)):
            return f"no such key here; {path[:-1]}={name} has it"
    return ""


def _keys(kind: type, tree: Any, path: str = "") -> Iterator[str]:
    """The dotted key of every setting and every group of settings."""
    for name, hint in typing.get_type_hints(kind).items():
        yield path + name
        options, _ = _options(hint)
        if dataclasses.is_dataclass(options[0]):
            below = tree.get(name) if isinstance(tree, dict) else None
            below = below if isinstance(below, dict) else {}
            yield from _keys(_variant(options, below), below, f"{path}{name}.")
