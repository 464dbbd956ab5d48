"""Pydantic models of the files of a run, which are checked before anything uses their values.

A matching SHA-256 does not prove that a file is what megastep wrote: strangers can compute it, too.
Keys that a model does not list are ignored, since later versions may write them.
"""

from typing import Annotated, Any, NoReturn

import pydantic
from pydantic import ConfigDict, Field

from megastep.agents.errors import shortened

_Count = Annotated[int, Field(ge=0, lt=2**63)]
_Number = Annotated[float, Field(allow_inf_nan=False, ge=0)]


class _Model(pydantic.BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")


class File(_Model):
    """An entry of a manifest."""

    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    bytes: _Count


class Numbers(_Model):
    """The numbers at the top level of a state. Snapshots have none."""

    __pydantic_extra__: dict[str, bool | int | float]
    samples: _Count = 0
    updates: _Count = 0
    seconds: _Number = 0.0


class Progress(_Model):
    """The numbers that the manifest of a run's checkpoint repeats from its state."""

    samples: _Count
    seconds: _Number


class Counts(_Model):
    """The counts in the state of a run that can be resumed."""

    samples: _Count
    updates: _Count
    samples_at_report: _Count
    seconds: _Number


COUNTS = (*Counts.model_fields,)


class Manifest(_Model):
    """manifest.json of a checkpoint."""

    step: _Count
    score: float | None
    numbers: Numbers
    files: dict[str, File]
    made_with: dict[str, str | int | float | None] = {}


class _Member(_Model):
    name: str


class Trained(_Model):
    """The structure of a run's settings. Each value is checked when it is used."""

    env: _Member
    geometry: _Member
    learner: _Member
    agent: dict[str, Any]
    opponents: dict[str, Any] = {}
    finish: dict[str, Any] = {}
    logger: dict[str, Any] = {}
    samples: _Number | None = None
    seconds: _Number | None = None


class Config(_Model):
    """config.json of a checkpoint."""

    train: Trained
    spaces: dict[str, str]


class Facts(_Model):
    """How an agent was trained."""

    __pydantic_extra__: dict[str, str | int | float | None | list[str]]
    samples: _Count


class _Table(_Model):
    title: str
    command: str
    rows: list[dict[str, Any]]


class Tables(pydantic.RootModel[list[_Table]]):
    """The evaluations of an agent."""


class Row(_Model):
    """A line of metrics."""

    __pydantic_extra__: dict[str, bool | int | float | str | None]
    samples: _Count


def check(model: type[pydantic.BaseModel], value: Any) -> None:
    """Raises ValueError that names the first wrong key if a value does not fit a model."""
    try:
        model.model_validate(value)
    except pydantic.ValidationError as error:
        _refuse(error.errors(include_url=False, include_input=False)[0])


def _refuse(line) -> NoReturn:
    name = shortened(".".join(map(str, line["loc"])) or "it", 60)
    raise ValueError(f"{name}: {shortened(line['msg'])}") from None
