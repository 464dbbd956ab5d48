"""The settings of the scripts as frozen dataclasses, checked by their annotations. Knows no Hydra.

Those of components are the arguments of their constructors; configs/ holds the defaults of a run.
"""

import copy
import dataclasses
import functools
import inspect
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

from pydantic import AfterValidator, BeforeValidator, Field

from megastep.agents.factory import components, conflicts
from megastep.agents.population.variation import Variation
from megastep.imports import import_object
from megastep.settings import frozen

T = TypeVar("T")


def _listed(names: object) -> object:
    names = [names] if isinstance(names, str) else names
    return tuple(names) if isinstance(names, list) else names


def _players(names: object) -> object:
    """Returns the names of `baseline=`: `true` is random actions; `false` and `none` are nobody."""
    is_nobody = names in (None, False, "none")
    return _listed([] if is_nobody else "random" if names is True else names)


def _callback(name: str) -> str:
    kind = import_object(name)
    try:
        inspect.signature(kind).bind()
    except TypeError as error:
        raise ValueError(f"{name} must take no arguments ({error})") from None
    return name


#: Units of seconds, and factors of counts.
UNITS = {
    "seconds": {"s": 1, "sec": 1, "m": 60, "min": 60, "h": 3600, "d": 86400},
    "samples": {"k": 1_000, "m": 1_000_000, "g": 1_000_000_000, "b": 1_000_000_000},
}


def quantity(text: object, kind: str) -> object:
    """Returns the number that people write as `100k` or `1h30min`; anything else as it is."""
    units = UNITS[kind]
    part = rf"(\d+(?:\.\d+)?(?:e\+?\d+)?) *({'|'.join(sorted(units, key=len, reverse=True))})"
    if not isinstance(text, str) or not re.fullmatch(rf"(?:{part} *)+", text.lower()):
        return text
    total = sum((float(n) * units[unit] for n, unit in re.findall(part, text.lower())), 0.0)
    return int(total) if total.is_integer() else total


def _device(name: str) -> str:
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", name):
        raise ValueError(f"{name!r} is unknown; there are auto, cpu, cuda, cuda:1, ...")
    return name


def _every(given: int | float | str) -> int | str:
    """Returns a number of samples, or text such as `60s`."""
    seconds, samples = (cast("float | str", quantity(given, kind)) for kind in UNITS)
    if isinstance(given, str) and re.fullmatch(r"[\d.]+ *m", given):
        raise ValueError(f"{given!r} may be minutes or millions: write min or M")
    is_time = isinstance(given, str) and not given.endswith("M") and not isinstance(seconds, str)
    if is_time and 0 < cast(float, seconds) < 1e9:
        return f"{seconds}s"
    if is_time or isinstance(samples, str) or samples < 1 or samples != int(samples):
        raise ValueError(f"{given!r} is neither samples, such as 1M, nor a time, such as 60s")
    return int(samples)


def every(value: float | str) -> tuple[float, str]:
    """Returns (number, "samples" or "seconds") of `evaluation.every`."""
    return (float(value[:-1]), "seconds") if isinstance(value, str) else (value, "samples")


Seconds = Annotated[
    float, Field(gt=0), BeforeValidator(functools.partial(quantity, kind="seconds"))
]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Steps = Annotated[int, Field(ge=1, le=100_000)]
Samples = Annotated[
    int, Field(ge=1, le=10**18), BeforeValidator(functools.partial(quantity, kind="samples"))
]
#: Names, of which a single one needs no brackets.
Names = Annotated[tuple[str, ...], BeforeValidator(_listed)]
Split = Literal["training", "test", "all"]
PopulationMember = int | Literal["best"] | None


# ---- Groups ----


def _group(group: str) -> object:
    """Returns the type of a field that holds the settings of a group's member."""

    def settings(value) -> object:
        if dataclasses.is_dataclass(value):
            return value
        if not isinstance(value, dict):
            raise ValueError(f"is a group of keys, got {value!r}")
        name = components.SINGLE.get(group) or value.get("name")
        if name is None:
            raise ValueError(f"has keys and is not chosen: give {group}= as well")
        return components.adapter(components.kind_of(group, str(name))).validate_python(value)

    return Annotated[Any, BeforeValidator(settings)]


def _default(group: str) -> Any:
    """Returns a field with the defaults of a group that has a single member."""
    return dataclasses.field(default_factory=functools.partial(components.settings_for, group))


def changed(settings: T, **changes: object) -> T:
    """Returns a copy of settings with other values, which are not checked again."""
    result = copy.copy(settings)
    for name, value in changes.items():
        if not hasattr(settings, name):
            raise TypeError(f"{type(settings).__name__} has no setting {name}")
        object.__setattr__(result, name, value)  # of a frozen class
    return result


def changed_known(settings: T, **changes: object) -> T:
    """Returns a copy of settings with those of the changes that it has."""
    return changed(settings, **{k: v for k, v in changes.items() if hasattr(settings, k)})


if TYPE_CHECKING:

    class Component:
        """The settings of a group's member: its import path, and what its constructor takes."""

        name: str

        def __getattr__(self, key: str) -> Any: ...

    Env = Geometry = Learner = Curriculum = Logger = Agent = Opponents = Component
else:
    Env, Geometry, Learner, Curriculum, Logger = map(_group, components.CHOSEN)
    Agent, Opponents = map(_group, components.SINGLE)


# ---- Scripts ----


@frozen
class Common:
    """Settings of every script."""

    seed: Annotated[int, Field(ge=0, lt=2**63)]
    device: Annotated[str, AfterValidator(_device)]
    trust: bool = False  # import what checkpoints that others made name


@frozen
class Finish:
    evaluate: bool
    episodes: Count
    record: bool
    steps: Steps
    report: bool = False


@frozen
class Logging:
    every: Count = 100
    profile: Annotated[int, Field(ge=0, le=1000)] = 0


@frozen
class Evaluation:
    every: Annotated[int | float | str, AfterValidator(_every)] | None = None
    episodes: Count = 128
    stop: dict[str, Annotated[float, Field(allow_inf_nan=False)]] = dataclasses.field(
        default_factory=dict
    )


@frozen
class Checkpoints:
    seconds: Seconds = 30.0
    keep: Annotated[int, Field(ge=2, le=1000)] = 2
    replay_every: Count = 20
    snapshots: Annotated[int, Field(ge=0, le=1000)] = 0


@frozen
class Population:
    size: Annotated[int, Field(ge=1, le=1024)] = 1
    every: Samples = 20_000_000
    vary: dict[str, Variation] = dataclasses.field(default_factory=dict)
    score: str = "running"
    member: int | None = None


@frozen
class Train(Common):
    env: Env
    geometry: Geometry
    agent: Agent = _default("agent")
    learner: Learner
    curriculum: Curriculum = cast("Curriculum", components.NoCurriculum(name="none"))
    opponents: Opponents = _default("opponents")
    population: Population = Population()
    logger: dict[str, Logger] = dataclasses.field(default_factory=dict)  # by label, such as wandb
    finish: Finish
    samples: Samples | None
    seconds: Seconds | None
    more_samples: Samples | None = None
    more_seconds: Seconds | None = None
    logging: Logging = Logging()
    evaluation: Evaluation = Evaluation()
    checkpoints: Checkpoints = Checkpoints()
    desync: bool = True
    callbacks: Annotated[
        tuple[Annotated[str, AfterValidator(_callback)], ...], BeforeValidator(_listed)
    ] = ()
    ranks: Annotated[int, Field(ge=1, le=10_000)] | Literal["all"] = 1
    dry_run: bool = False
    folder: str | None
    resume: str | None
    rerun: str | None = None
    init: str | None
    member: PopulationMember = None

    def conflicts(self) -> Iterator[tuple[str, str]]:
        return conflicts.of_training(self)


@frozen
class Trained:
    """What a trained agent needs to play: no learner or logger, whose class may not be here."""

    seed: int
    env: Env
    geometry: Geometry
    agent: Agent
    opponents: Opponents = _default("opponents")


@frozen
class Played(Common):
    """Settings of what plays with a trained agent."""

    env: Env | None = None
    geometry: Geometry | None = None
    split: Split
    greedy: bool
    member: PopulationMember = None


def _needed(cure: str) -> BeforeValidator:
    def given(value: T | None) -> T:
        if value is None:
            raise ValueError(f"is missing; {cure}")
        return value

    return BeforeValidator(given)


@frozen
class Evaluate(Played):
    run: Annotated[str, _needed("run=latest takes the newest run, run=FOLDER another one")]
    episodes: Count
    max_steps: Count | None = None  # None: the environment's own limit
    baseline: Annotated[tuple[str, ...], BeforeValidator(_players)]
    against: Names | None = None
    ratings: bool = False


@frozen
class Dump(Played):
    run: str | None
    bot: str | None
    episodes: Annotated[int, Field(ge=1, le=10_000_000)]
    max_steps: Steps | None = None  # None: the environment's own limit
    format: Literal["npz", "minari", "lerobot"] = "npz"
    folder: Annotated[str, _needed("folder=FOLDER is a new folder for the dataset")]
    truth: bool = False

    def conflicts(self) -> Iterator[tuple[str, str]]:
        return conflicts.of_dumping(self)


Home = Annotated[int, Field(ge=0, le=1_000_000)]


@frozen
class Record(Played):
    run: str | None
    runs: Annotated[tuple[str, ...], Field(min_length=2, max_length=9)] | None = None
    steps: Steps
    home: Home | None
    homes: Annotated[tuple[Home, ...], Field(min_length=1, max_length=16)] | None = None
    against: str | None = None
    file: str | None
    title: str | None = None
    theme: Literal["light", "dark"] = "light"
    dpi: Annotated[float, Field(ge=20, le=400)] = 100.0
    speed: Annotated[float, Field(gt=0, le=100)] = 1.0
    trail: Annotated[int, Field(ge=0, le=10_000)] = 60

    def conflicts(self) -> Iterator[tuple[str, str]]:
        return conflicts.of_recording(self)
