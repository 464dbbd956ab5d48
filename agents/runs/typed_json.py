"""The reader of strings and numbers in the files of a run: JSON, checked against types.

It can also hold infinity, NaN, and dicts with keys other than strings:

    {"cap": inf, "prices": {0: 1.0}}
    {"cap": {"$float": "inf"}, "prices": {"$dict": [[0, 1.0]]}}
"""

import functools
import json
import math
from typing import Annotated, Any, cast

import pydantic
from pydantic import BeforeValidator, Field
from typing_extensions import NotRequired, TypedDict

from megastep.agents.errors import shortened

FLOAT, DICT = "$float", "$dict"
_Count = Annotated[int, Field(ge=0, lt=2**63)]
_Number = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_File = Annotated[str, Field(pattern=r"^((state|world|replay|rank[1-9]\d*)\.pt|config\.json)$")]


#: A line of metrics.
Row = dict[str, bool | int | float | str | None]


def _object(**kinds: Any) -> Any:
    """Returns the kind of an object with these keys, and perhaps others."""
    return cast(Any, TypedDict)("Object", kinds)


#: manifest.json of a checkpoint.
Manifest = _object(
    step=_Count,
    score=float | None,
    numbers=dict[str, bool | int | _Number],
    files=dict[_File, _object(sha256=str, bytes=_Count)],
    made_with=Row,
)
_member = _object(name=str)
#: config.json of a checkpoint. Each setting is checked when it is used.
Config = _object(
    train=_object(env=_member, geometry=_member, learner=_member, agent=dict[str, Any]),
    spaces=dict[str, str],
)
#: config.yaml of a run, which is drawn and not used.
ConfigYaml = _object(env=dict, geometry=NotRequired[dict])
#: How the agent in an agent file was trained, and one of its evaluations.
Facts = _object(samples=_Count)
Table = _object(title=str, command=str, rows=list[dict[str, Any]])
#: Keys of numbers in the lines of a run begin with these; others, as of a curriculum, may be text.
_NUMBERS = "episode/", "eval/", "loss/", "perf/", "settings/", "score", "diverged", "updates"
#: Of them, those that are never null, as others are that were not finite.
_FINITE = "episode/window", "episode/count", "perf/seconds", "settings/", "diverged"


def _numbers(row: dict[str, Any]) -> dict[str, Any]:
    for key, value in row.items():
        is_right = not key.startswith(_FINITE if value is None else _NUMBERS)
        if isinstance(value, (int, float)):
            is_right = abs(value) < 1e300
        if not is_right:
            raise ValueError(f"{key} cannot be {shortened(repr(value), 40)}")
    return row


#: A line of metrics.jsonl or perf.jsonl, of population.jsonl, of provenance.jsonl.
Metrics = Annotated[_object(samples=_Count), BeforeValidator(_numbers)]
Generation = Annotated[
    _object(samples=_Count, generation=_Count, member=_Count, **{"from": _Count}),
    BeforeValidator(_numbers),
]
Start = _object(samples=_Count, command=NotRequired[str], commit=NotRequired[str])
_Means = dict[str, dict[str, float | None]]
_result = dict.fromkeys(("return", "won", "lower", "upper", "length"), NotRequired[float | None])
_result |= dict.fromkeys(("agent", "against", "role", "source"), NotRequired[str])
_result |= dict(homes=NotRequired[_Count | None], tail=NotRequired[float])
_result |= dict.fromkeys(("lanes", "unfinished", "duels"), NotRequired[_Count])
_result |= dict(metrics=NotRequired[_Means])
_how = dict(split=NotRequired[str], greedy=NotRequired[bool])
_how |= dict(geometry=NotRequired[dict[str, Any] | None])
_how |= dict.fromkeys(("baseline", "against"), NotRequired[list[str] | None])
#: evaluations/*.json.
Evaluation = _object(
    title=str,
    rows=Annotated[list[_object(**_result)], Field(min_length=1)],
    step=NotRequired[_Count],
    evaluation=NotRequired[_object(**_how)],
    episodes=NotRequired[dict[str, list]],
)


def dumps(value: Any, indent: int | None = None) -> str:
    """Returns nested dicts and lists of strings, numbers, true, false and None as text."""
    return json.dumps(encoded(value), indent=indent, allow_nan=False)


def loads(text: str | bytes, kind: object = None) -> Any:
    """The inverse of `dumps`. ValueError for other texts, and for values not of the `kind`."""
    try:
        value = json.loads(text, object_hook=_decoded)
    except RecursionError:
        raise ValueError("it is too deeply nested") from None
    if kind is not None:
        check(kind, value)
    return value


def check(kind: object, value: object) -> None:
    """Raises ValueError, with the first wrong key, for a value of another kind."""
    try:
        _adapter(kind).validate_python(value, strict=True)
    except pydantic.ValidationError as error:
        line = error.errors(include_url=False, include_input=False)[0]
        name = shortened(".".join(map(str, line["loc"])) or "it", 60)
        text = shortened(line["msg"].removeprefix("Value error, "))
        raise ValueError(f"{name}: {text}") from None


_adapter = functools.cache(pydantic.TypeAdapter)


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
