"""Settings from nested dicts, checked in one pass: `build(Train, tree)`. Knows no Hydra."""

import dataclasses
import json
from collections.abc import Iterable, Iterator
from typing import Any

from pydantic import TypeAdapter, ValidationError

from megastep.agents.cli.errors import ConfigErrors, closest_key
from megastep.agents.cli.settings import GROUPS
from megastep.settings import sentence

#: Keys that no setting has.
UNKNOWN = ("unexpected_keyword_argument", "extra_forbidden")


def build(kind: type, tree: dict[str, Any], choices: Iterable[str] = ()) -> Any:
    """The settings of dataclass `kind` from nested dicts; raises `ConfigErrors` with all that is
    wrong, not the first. `choices` are names that may have been meant beside those of keys.
    """
    try:
        # As text, for a configuration is text: a list in it stands for a tuple, a word for a path.
        return TypeAdapter(kind).validate_json(json.dumps(_whole(tree)))
    except ValidationError as error:
        keys, told = [*keys_of(kind, tree), *choices], {}
        for one in error.errors():
            path, text = _sentence(kind, tree, one, keys)
            told.setdefault(path, text)
        raise ConfigErrors(told.items()) from None


def as_tree(settings: Any) -> dict[str, Any]:
    """Nested plain dicts, the inverse of `build`."""
    return TypeAdapter(type(settings)).dump_python(settings, mode="json")


def _whole(tree: Any) -> Any:
    """The tree with integers for numbers such as 1e6, which YAML reads as fractions."""
    if isinstance(tree, dict):
        return {key: _whole(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_whole(value) for value in tree]
    return int(tree) if isinstance(tree, float) and tree.is_integer() else tree


def _sentence(kind: type, tree: Any, error: dict, keys: list[str]) -> tuple[str, str]:
    """The dotted key of one of pydantic's errors, and what to say of it."""
    path, field, group = [], None, None
    for part in error["loc"]:
        if kind is None:
            break  # inside a list, or an option of several types
        field, group = kind.__pydantic_fields__.get(part), GROUPS.get(path[0]) if path else None
        path.append(str(part))
        tree = tree.get(part) if isinstance(tree, dict) else None
        kind = _below(part, field, tree)
    key = ".".join(path)
    if error["type"] not in UNKNOWN:
        return key, sentence(error, field, tree)
    other = group.having(path[-1]) if group and len(path) == 2 else None
    if other:
        return key, f"no such key here; {path[0]}={other} has it"
    return key, f"no such key; {closest_key(key, keys)}"


def _below(key: str, field: Any, tree: Any) -> type | None:
    """The dataclass of the settings below a key, if it is that of a group."""
    if key in GROUPS and isinstance(tree, dict):
        try:
            return GROUPS[key].kind(str(tree.get("name")))
        except ValueError:
            return None
    kind = getattr(field, "annotation", None)
    return kind if dataclasses.is_dataclass(kind) else None


def keys_of(kind: type, tree: Any, path: str = "") -> Iterator[str]:
    """The dotted key of every setting and every group of settings."""
    for name, field in kind.__pydantic_fields__.items():
        yield path + name
        tree_below = tree.get(name) if isinstance(tree, dict) else None
        if below := _below(name, field, tree_below):
            yield from keys_of(below, tree_below, f"{path}{name}.")
