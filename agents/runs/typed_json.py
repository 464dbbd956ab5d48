"""The reader of strings and numbers in the files of a run: JSON, checked against a pydantic model.

The JSON can also hold infinity, NaN, and dicts with keys other than strings:

    {"cap": inf, "prices": {0: 1.0}}
    {"cap": {"$float": "inf"}, "prices": {"$dict": [[0, 1.0]]}}
"""

import json
import math
from typing import Annotated, Any

import pydantic
from pydantic import ConfigDict, Field

from megastep.agents.errors import shortened

FLOAT, DICT = "$float", "$dict"
_Count = Annotated[int, Field(ge=0, lt=2**63)]
_Number = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Name = Annotated[str, Field(pattern=r"^((state|world|replay|rank[1-9]\d*)\.pt|config\.json)$")]


class _Model(pydantic.BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")


class _Numbers(_Model):
    __pydantic_extra__: dict[str, bool | int | float]
    samples: _Count = 0
    updates: _Count = 0
    seconds: _Number = 0.0


class _File(_Model):
    sha256: str
    bytes: _Count


class Manifest(_Model):
    """manifest.json of a checkpoint. Snapshots, which hold weights alone, have no numbers."""

    step: _Count
    score: float | None
    numbers: _Numbers
    files: dict[_Name, _File]
    made_with: dict[str, str | int | float | None]


class _Member(_Model):
    name: str


class _Trained(_Model):
    env: _Member
    geometry: _Member
    learner: _Member
    agent: dict[str, Any]


class Config(_Model):
    """config.json of a checkpoint. Each setting is checked when it is used."""

    train: _Trained
    spaces: dict[str, str]


class Facts(_Model):
    """How the agent in an agent file was trained."""

    __pydantic_extra__: dict[str, str | int | float | None | list[str]]
    samples: _Count


class _Table(_Model):
    title: str
    command: str
    rows: list[dict[str, Any]]


class Tables(pydantic.RootModel[list[_Table]]):
    """The evaluations in an agent file."""


class Row(_Model):
    """A line of metrics."""

    __pydantic_extra__: dict[str, bool | int | float | str | None]
    samples: _Count


class _Generation(_Model):
    samples: _Count
    generation: _Count
    member: _Count
    source: Annotated[_Count, Field(alias="from")]


class Generations(pydantic.RootModel[list[_Generation]]):
    """The lines of a population's members."""


def dumps(value: Any, indent: int | None = None) -> str:
    """Returns nested dicts and lists of strings, numbers, true, false and None as text."""
    return json.dumps(encoded(value), indent=indent, allow_nan=False)


def loads(text: str | bytes, model: type[pydantic.BaseModel] | None = None) -> Any:
    """The inverse of `dumps`.

    Raises:
        ValueError: `dumps` cannot have written the text; or the value does not fit the model, with
            the first wrong key.
    """
    try:
        value = json.loads(text, object_hook=_decoded)
    except RecursionError:
        raise ValueError("it is too deeply nested") from None
    if model is not None:
        check(model, value)
    return value


def check(model: type[pydantic.BaseModel], value: object) -> None:
    """Raises ValueError, with the first wrong key, for a value that does not fit a model. Keys that
    the model does not list may be there.
    """
    try:
        model.model_validate(value)
    except pydantic.ValidationError as error:
        line = error.errors(include_url=False, include_input=False)[0]
        name = shortened(".".join(map(str, line["loc"])) or "it", 60)
        raise ValueError(f"{name}: {shortened(line['msg'])}") from None


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
