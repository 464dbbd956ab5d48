"""key=value words in Hydra's grammar, or keyword arguments, as settings."""

import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser import overrides_parser, types
from hydra.errors import HydraException

from megastep.agents.errors import ConfigErrors, shortened
from megastep.agents.factory.check import Tree

#: An element of a value with = in it, as folders of sweeps have, and what quotes it.
WITH_EQUALS, QUOTED = re.compile(r"[^\[\],]*=[^\[\],]*"), r'"\g<0>"'


class Typed(NamedTuple):
    """A setting that was given."""

    key: str
    value: Any
    word: str  # how Hydra's grammar has it, where it chooses a member of a group
    is_delete: bool = False
    is_added: bool = False


def parse(
    words: Iterable[str],
    kind: Any,
    cure: Callable[[str], str] = str,
    loader: ConfigLoader | None = None,
) -> list[types.Override]:
    """Returns words as Hydra's grammar reads them. ConfigErrors with all unreadable ones."""
    parser = overrides_parser.OverridesParser.create(loader)
    fields = kind.__pydantic_fields__.items()
    lists = [name for name, field in fields if "tuple" in repr(field.annotation)]
    overrides: list[types.Override] = []
    errors = []
    for word in words:
        key, _, value = word.partition("=")
        if "=" not in word and not word.startswith("~"):
            errors.append((shortened(word or "''"), cure(word)))
            continue
        if key in lists and "," in value and not value.startswith(("[", '"', "'")):
            word = f"{key}=[{value}]"
        texts = (word, f"{key}={WITH_EQUALS.sub(QUOTED, value)}") if key else ()
        for text in texts:
            with suppress(HydraException, ValueError, RecursionError):
                overrides += parser.parse_overrides([text])
                break
        else:
            text = "cannot be read; write key=value, and quote blanks: 'key=\"a b\"'"
            errors.append((shortened(word), text))
    if errors:
        raise ConfigErrors(errors)
    return overrides


def key_of(override: types.Override) -> str:
    """The key or group@package of a word, without the sign before it."""
    return override.get_key_element().lstrip("+~")


def typed_word(override: types.Override) -> Typed:
    """Returns the setting of a word."""
    is_added = override.is_add() or override.is_force_add()
    word = str(override.input_line)
    return Typed(key_of(override), override.value(), word, override.is_delete(), is_added)


def plain_tree(kind: Any, words: list[str]) -> Tree:
    """Returns the settings that words give a command without files. Its first key needs no `=`."""
    first = next(iter(kind.__pydantic_fields__))
    overrides = parse([word if "=" in word else f"{first}={word}" for word in words], kind)
    keys = [key_of(one) for one in overrides]
    errors = [(key, "is given twice") for key in {*keys} if keys.count(key) > 1]
    errors += [(key_of(one), "takes one value") for one in overrides if one.is_sweep_override()]
    if errors:
        raise ConfigErrors(errors)
    return {key_of(one): one.value() for one in overrides}


def typed_of(arguments: Mapping[str, Any]) -> list[Typed]:
    """Returns settings from keyword arguments: values, dotted keys, and dicts of a group's keys."""
    typed = []
    for key, value in arguments.items():
        if isinstance(value, Mapping) and "." not in key:
            # the name decides what other keys there are
            name = {key: value["name"]} if "name" in value else {}
            rest = {f"{key}.{inner}": one for inner, one in value.items() if inner != "name"}
            typed += typed_of(name | rest)
        else:
            text = f"[{','.join(map(str, value))}]" if isinstance(value, list) else str(value)
            typed.append(Typed(key, value, f"{key}={'null' if value is None else text}"))
    return typed
