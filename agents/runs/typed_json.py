"""JSON that can also hold infinity, NaN, and dicts with keys other than strings.

    {"cap": inf, "prices": {0: 1.0}}
    {"cap": {"$float": "inf"}, "prices": {"$dict": [[0, 1.0]]}}

Everything else is plain JSON, so files of earlier versions can be read.
"""

import json
import math
from typing import Any

FLOAT, DICT = "$float", "$dict"


def dumps(value: Any, indent: int | None = None) -> str:
    """Returns nested dicts and lists of strings, numbers, true, false and None as text."""
    return json.dumps(encoded(value), indent=indent, allow_nan=False)


def loads(text: str | bytes) -> Any:
    """The inverse of `dumps`. Raises ValueError if `dumps` cannot have written the text."""
    return json.loads(text, object_hook=_decoded)


def encoded(value: Any) -> Any:
    """Replaces what plain JSON cannot hold by `{FLOAT: ...}` and `{DICT: ...}`."""
    if isinstance(value, float) and not math.isfinite(value):
        return {FLOAT: str(value)}
    if isinstance(value, (list, tuple)):
        return [*map(encoded, value)]
    if not isinstance(value, dict):
        return value
    if all(isinstance(key, str) for key in value) and not {FLOAT, DICT} & value.keys():
        return {key: encoded(part) for key, part in value.items()}
    return {DICT: [[encoded(key), encoded(part)] for key, part in value.items()]}


def _decoded(value: dict[str, Any]) -> Any:
    try:
        if value.keys() == {FLOAT}:
            return float(value[FLOAT])
        return dict(value[DICT]) if value.keys() == {DICT} else value
    except TypeError as error:
        raise ValueError(f"{value!r} is not what was saved: {error}") from None
