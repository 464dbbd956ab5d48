"""Words of commands that have no configuration: key=value, as on every command line."""

from collections.abc import Mapping

from megastep.agents.errors import UserError
from megastep.settings import closest


def parse(words: list[str], keys: Mapping[str, bool]) -> dict[str, list[str]]:
    """Returns {key: its values} for words such as `run=[a,b]`, `run=a,b` or `file=x.pdf`.

    Args:
        keys: every key, and whether it takes several values.

    Raises:
        UserError: another key, a key given twice, no value, or several values for a key of one.
    """
    found: dict[str, list[str]] = {}
    for word in words:
        key, equals, text = word.removeprefix("--").partition("=")
        if not equals:
            raise UserError(f"{word!r} is not key=value; the keys are {', '.join(keys)}")
        if key not in keys:
            raise UserError(f"{key}: no such key; {closest(key, keys)}")
        if key in found:
            raise UserError(f"{key} is given twice")
        is_list = text.startswith("[") and text.endswith("]")
        values = text[1:-1].split(",") if is_list else text.split(",") if keys[key] else [text]
        found[key] = [value.strip().strip("'\"") for value in values]
        if not all(found[key]):
            raise UserError(f"{word} has no value; write {key}=VALUE")
        if len(found[key]) > 1 and not keys[key]:
            raise UserError(f"{key} takes one value, but {len(found[key])} were given")
    return found
