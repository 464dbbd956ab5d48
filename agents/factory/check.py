"""Settings from nested dicts, checked in one pass: `check(Train, tree)`. Knows no Hydra."""

import contextlib
import dataclasses
import difflib
from collections.abc import Callable, Iterable, Iterator
from types import NoneType
from typing import Any, TypeVar, cast, get_args

from pydantic import ValidationError
from pydantic_core import PydanticSerializationError, to_jsonable_python

from megastep.agents.errors import ConfigErrors
from megastep.agents.factory import components
from megastep.settings import sentence

Tree = dict[str, Any]
T = TypeVar("T")


def check(kind: type[T], tree: Tree, names: Callable[[], Iterable[str]] = tuple) -> T:
    """Returns checked settings from nested dicts. ConfigErrors names all errors at once."""
    try:
        chosen = components.adapter(kind).validate_python(tree)
    except ValidationError as error:
        fields, errors = dict(fields_of(kind, tree)), {}
        for line in error.errors():
            path = [str(part) for part in line["loc"]]
            if line["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
                text = _unknown(path, [*fields, *names()])
            else:
                # inside a list, or an option of a union
                while len(path) > 1 and ".".join(path) not in fields:
                    path.pop()
                text = sentence(line)
            key = ".".join(path) or "configuration"
            if key in errors and line["type"] == "literal_error":  # another option of a union
                errors[key] += f"; {line.get('ctx', {})['expected']} is allowed too"
            errors.setdefault(key, text)
        raise ConfigErrors(errors.items()) from None
    if conflicts := [*getattr(chosen, "conflicts", tuple)()]:
        raise ConfigErrors(conflicts)
    as_tree(chosen)
    return cast(T, chosen)


def as_tree(value: Any, prefix: str = "") -> Any:
    """The inverse of `check`: a value as JSON has it, but with keys, infinity and NaN as they are.
    Raises ConfigErrors for settings that no file can hold.
    """
    if dataclasses.is_dataclass(value):
        kind, tree = cast(Any, type(value)), {}
        for name, field in kind.__pydantic_fields__.items():
            part = getattr(value, name)
            try:
                tree[name] = as_tree(part, f"{prefix}{name}.")
            except PydanticSerializationError:
                if part is not field.get_default(call_default_factory=True):
                    text = f"{part!r} cannot be kept in a checkpoint; use numbers, words and lists"
                    raise ConfigErrors([(prefix + name, text)]) from None
        return tree
    if isinstance(value, dict):
        return {as_tree(key): as_tree(part, f"{prefix}{key}.") for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_tree(part) for part in value]
    is_scalar = type(value) in (str, int, float, bool, type(None))
    return value if is_scalar else to_jsonable_python(value)


def fields_of(kind: type, tree: object, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields (dotted key, pydantic's field) of the settings; `tree` names members of groups."""
    for name, field in kind.__pydantic_fields__.items():
        yield prefix + name, field
        value = tree.get(name) if isinstance(tree, dict) else None
        members: Tree = {f"{prefix}{name}": value}
        if name == "logger" and isinstance(value, dict):
            members = {f"{prefix}logger.{label}": one for label, one in value.items()}
            yield from ((key, field) for key in members)
        for key, member in members.items():
            below = field.annotation
            if name in components.GROUPS:
                with contextlib.suppress(KeyError, TypeError, ValueError):
                    path = components.SINGLE.get(name) or str(member["name"])
                    below = components.kind_of(name, path)
            if NoneType in get_args(below):
                below = next(filter(dataclasses.is_dataclass, get_args(below)), below)
            if isinstance(below, type) and dataclasses.is_dataclass(below):
                yield from fields_of(below, member, f"{key}.")


def leaves(tree: Tree, prefix: str = "") -> list[tuple[str, Any]]:
    """[(dotted key, value)] of nested dicts."""
    if not isinstance(tree, dict):
        return [(prefix[1:], tree)]
    return [leaf for key, below in tree.items() for leaf in leaves(below, f"{prefix}.{key}")]


def closest_key(key: str, keys: Iterable[str]) -> str:
    """Returns a hint that names the nearest key, or lists those of the group if none is near."""
    # by the whole key or its last part: `lr` and `learner.lrr` find `learner.lr`
    names = [*keys]
    named = {name.rpartition(".")[2]: name for name in names} | {name: name for name in names}
    for part in key, key.rpartition(".")[2]:
        if near := difflib.get_close_matches(part, named, n=1, cutoff=0.75):
            return f"did you mean {named[near[0]]}?"
    group = f"{key.rpartition('.')[0]}."
    inside = {name[len(group) :].partition(".")[0] for name in names if name.startswith(group)}
    if inside:
        return f"{group[:-1]} has {', '.join(sorted(inside))}"
    return f"there are {', '.join(sorted({n.partition('.')[0] for n in names if '/' not in n}))}"


#: Keys of earlier versions, and the new ones.
MOVED = {
    "log_every": "logging.every",
    "profile": "logging.profile",
    "evaluate_every": "evaluation.every",
    "evaluate_episodes": "evaluation.episodes",
    "stop": "evaluation.stop",
    "checkpoint_seconds": "checkpoints.seconds",
    "keep_checkpoints": "checkpoints.keep",
    "replay_every": "checkpoints.replay_every",
    "snapshots": "checkpoints.snapshots",
}


def _unknown(path: list[str], keys: list[str]) -> str:
    group = path[0]
    if group in MOVED:
        return f"is now called {MOVED[group]}"
    if group in components.CHOSEN and len(path) == 2:
        for member, name in components.members(group).items():
            if path[1] in components.kind_of(group, name).__pydantic_fields__:
                return f"no such key here; {group}={member} has it"
    return f"no such key; {closest_key('.'.join(path), keys)}"
