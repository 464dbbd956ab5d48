"""The words of a command line in Hydra's grammar: parsed, enumerated, named. Knows no settings."""

import itertools
import re
from collections.abc import Iterable, Iterator
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from megastep.agents.cli.errors import ConfigErrors, shortened

#: What neither a shell, nor Hydra's grammar, nor a file system leaves alone in a name.
SPECIAL = re.compile(r"[^\w.=+-]+")
#: The longest key, member of a group, and part of a job's name; file systems allow 255 bytes.
LONGEST = 200
#: How deep a value may be nested: Python's own limit ends far deeper ones.
DEEPEST = 20
#: Where between the bounds of an interval a value is tried as well.
INSIDE = 0.38


def parse(words: Iterable[str], loader: Any = None, multirun: bool = False) -> list[Override]:
    """Overrides as Hydra's grammar has them; ConfigErrors names every word that is none. `loader`
    knows the members of groups, for `glob`.
    """
    errors, found = [], []
    for word in words:
        if _depth(word) > DEEPEST or len(word.partition("=")[0]) > LONGEST:
            errors.append((shortened(word), "is nested too deeply, or its key is too long"))
            continue
        override = _parsed(word) or _parsed(_quoted(word, multirun))
        if override is None or not override.key_or_group:
            cure = "write key=value, quote blanks and brackets: 'key=\"a b\"'"
            errors.append((shortened(word), f"is not understood; {cure}"))
            continue
        override.config_loader = loader
        found.append(override)
    if errors:
        raise ConfigErrors(errors)
    return found


def _depth(word: str) -> int:
    """How deep brackets are in brackets."""
    depths = itertools.accumulate((c in "[{(") - (c in "]})") for c in word)
    return max(depths, default=0)


def _parsed(word: str) -> Override | None:
    try:
        return OverridesParser.create().parse_override(word)
    except (HydraException, ValueError, RecursionError):  # of overlong and of nested values
        return None


def _quoted(word: str, multirun: bool) -> str:
    """The word with its value in quotes, one by one in a list or a sweep, if it has = in it, as the
    names of a sweep's folders do.
    """
    key, _, value = word.partition("=")
    is_list = value.startswith("[") and value.endswith("]")
    inner = value[1:-1] if is_list else value
    if "=" not in inner or re.search(r"[\[\](){}'\"]", inner):
        return word
    values = inner.split(",") if is_list or multirun else [inner]
    quoted = ",".join(f'"{one}"' for one in values)
    return f"{key}=[{quoted}]" if is_list else f"{key}={quoted}"


def is_hydra(override: Override) -> bool:
    """Whether it is one of Hydra's own settings."""
    return re.split(r"[./]", override.key_or_group)[0] == "hydra"


def key_of(override: Override) -> str:
    """The key or group, with its package, without what stands before it."""
    return override.get_key_element().lstrip("+~")


def combinations(overrides: list[Override], is_grid: bool) -> Iterator[list[str]]:
    """The words of each job of a sweep that can be told beforehand. Of a grid these are all; of a
    search, the first of all values, then every other value and bound alone.
    """
    values = {}  # of a key that is given twice the last one holds
    for override in overrides:
        values.pop(key_of(override), None)
        values[key_of(override)] = list(_values(override, is_grid))
    if is_grid:
        yield from ([word for word in job if word] for job in itertools.product(*values.values()))
        return
    first = {key: words[0] for key, words in values.items()}
    yield [word for word in first.values() if word]
    for key, words in values.items():
        for word in words[1:]:
            yield [word for word in (first | {key: word}).values() if word]


def _values(override: Override, is_grid: bool) -> Iterator[str | None]:
    """The words that an override may become; None where it is left out."""
    key, value = override.get_key_element(), override.value()
    if override.is_interval_sweep() or override.is_range_sweep() and not is_grid:
        if override.is_interval_sweep():
            low, high = value.start, value.end
            yield None
        else:
            low, high = value.start, value.stop
        inside = low + INSIDE * (high - low)
        if isinstance(low, int) and isinstance(high, int):
            inside = round(inside)
        yield from (f"{key}={one}" for one in (low, high, inside))
    elif override.is_sweep_override():
        found = [f"{key}={one}" for one in override.sweep_string_iterator()]
        if not found:
            raise ConfigErrors([(key_of(override), f"{override.input_line!r} has no value")])
        yield from found
    else:
        yield override.input_line


def varied(words: Iterable[str], fixed: Iterable[str]) -> dict[str, str]:
    """{key: value as text} of a job's words, but for Hydra's own and keys that are `fixed`."""
    found = {key_of(one): one for one in parse(words) if not is_hydra(one)}
    return {
        key: "null" if one.value() is None else str(one.value())
        for key, one in found.items()
        if key not in fixed
    }


def fixed_keys(words: Iterable[str]) -> list[str]:
    """The keys of a sweep's words that have one value."""
    last = {key_of(one): one for one in parse(words, multirun=True)}
    return [key for key, one in last.items() if not one.is_sweep_override()]


def name_of(values: dict[str, str]) -> str:
    """What varies as a part of a folder's name."""
    text = SPECIAL.sub("-", "_".join(f"{key}={value}" for key, value in values.items()))
    return text.encode()[:LONGEST].decode(errors="ignore") or "default"
