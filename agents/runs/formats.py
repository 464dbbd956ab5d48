"""What files of a run have to hold before anything reads them, as models of pydantic.

A file may come from a stranger whose SHA-256 is right. More keys than these are left alone, since
later versions may write them.
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
    """The numbers at the top of a state; none in a snapshot."""

    __pydantic_extra__: dict[str, bool | int | float]
    samples: _Count = 0
    updates: _Count = 0
    seconds: _Number = 0.0


class Progress(_Model):
    """The numbers at the top of the state of a run, as its manifest repeats them."""

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
    """The settings of a run, which are checked one by one when they are used."""

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
    """What made an agent."""

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
    """Raises ValueError, naming the first key, if a value is not what a model describes."""
    try:
        model.model_validate(value)
    except pydantic.ValidationError as error:
        _refuse(error.errors(include_url=False, include_input=False)[0])


def _refuse(line) -> NoReturn:
    name = shortened(".".join(map(str, line["loc"])) or "it", 60)
    raise ValueError(f"{name}: {shortened(line['msg'])}") from None
