"""The settings of the scripts as frozen dataclasses, checked by their annotations. Knows no Hydra.

configs/ holds the defaults of a run. The settings of environments, geometries, learners, agents and
opponents are the arguments of their constructors, with the bounds and defaults given there.
"""

import copy
import dataclasses
import functools
import inspect
import operator
import os
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from megastep.agents.factory import components
from megastep.agents.population.variation import Variation
from megastep.imports import import_object
from megastep.schedules import Scheduled
from megastep.settings import AtMost, closest, frozen, located

if TYPE_CHECKING:
    from typing_extensions import Self

    from megastep.agents.types import Config

T = TypeVar("T")


def _device(name: str) -> str:
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", name):
        raise ValueError(f"{name!r} is not a device; use auto, cpu, cuda or cuda:<number>")
    return name


def _listed(names: object) -> object:
    names = [names] if isinstance(names, str) else names
    return tuple(names) if isinstance(names, list) else names


def _callback(name: str) -> str:
    kind = import_object(name)
    try:
        inspect.signature(kind).bind()
    except TypeError as error:
        raise ValueError(f"{name} must take no arguments ({error})") from None
    return name


def _ranks(n: int | str) -> int | str:
    if n != "all" and (isinstance(n, str) or not 1 <= n <= 10_000):
        raise ValueError(f"{n!r} is not a number of ranks; use 1 or more, or all")
    return n


#: Units of seconds, and factors of counts.
UNITS = {
    "seconds": {"s": 1, "sec": 1, "m": 60, "min": 60, "h": 3600, "d": 86400},
    "samples": {"k": 1_000, "m": 1_000_000, "g": 1_000_000_000, "b": 1_000_000_000},
}


def quantity(text: object, kind: str) -> object:
    """Returns the number that people write as `100k` or `1h30min`; anything else as it is.

    Args:
        kind: a key of `UNITS`.
    """
    units = UNITS[kind]
    part = rf"(\d+(?:\.\d+)?(?:e\+?\d+)?) *({'|'.join(sorted(units, key=len, reverse=True))})"
    if not isinstance(text, str) or not re.fullmatch(rf"(?:{part} *)+", text.lower()):
        return text
    total = sum((float(n) * units[unit] for n, unit in re.findall(part, text.lower())), 0.0)
    return int(total) if total.is_integer() else total


def _every(given: int | float | str) -> int | str:
    """Returns a number of samples, or text such as `60s`."""
    seconds, samples = (cast("float | str", quantity(given, kind)) for kind in UNITS)
    if isinstance(given, str) and re.fullmatch(r"[\d.]+ *m", given):
        raise ValueError(f"{given!r} may be minutes or millions: write min or M")
    is_samples = isinstance(given, str) and given.endswith("M")
    if isinstance(given, str) and not isinstance(seconds, str) and not is_samples:
        if not 0 < seconds < 1e9:
            raise ValueError(f"{given!r} is no time")
        return f"{seconds}s"
    if isinstance(samples, str) or samples < 1 or samples != int(samples):
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
Member = int | Literal["best"] | None
FILMS = ".mp4", ".gif", ".png", ".svg", ".pdf"  # endings of what record.py can write


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
            raise ValueError(f"its keys need a member: give {group}= as well")
        return components.adapter(components.kind_of(group, str(name))).validate_python(value)

    return Annotated[Any, BeforeValidator(settings)]


def changed(settings: T, **changes: object) -> T:
    """Returns a copy of settings with those of the changes that it has.

    Nothing is checked again, since a stranger's default need not be what its annotation says.
    """
    result = copy.copy(settings)
    for name, value in changes.items():
        if hasattr(settings, name):
            object.__setattr__(result, name, value)  # of a frozen class
    return result


def ignored_geometry(env: "Env | None", typed: list[str]) -> list[tuple[str, str]]:
    """Returns [(key, sentence)] of the first typed key that chooses a geometry, if the environment
    takes none. `env` may be None, that of a run.
    """
    keys = [key for key in typed if key.split(".")[0] == "geometry"]
    if not keys or env is None or components.takes_geometries(env.name):
        return []
    return [(keys[0], f"env={env_name(env)} takes no floor plans; leave geometry out")]


def label(name: str) -> str:
    """`explorer` for megastep.envs.explorer:Explorer."""
    return name.rpartition(":")[2].rpartition(".")[2].lower()


def env_name(env: "Env") -> str:
    """What an environment is called in titles, from its settings: `explorer`, or the id that one of
    other packages has, `CartPole-v1`.
    """
    return getattr(env, "id", None) or label(env.name)


def run_name(cfg: "Train") -> str:
    """What the folder of a run is called after the time, from its settings."""
    geometry = [label(cfg.geometry.name)] if components.takes_geometries(cfg.env.name) else []
    return "-".join([env_name(cfg.env), *geometry, str(cfg.seed)])


def _chosen_loggers(tree) -> dict:
    """Returns nested dicts of loggers by label. Raises for keys of loggers that were not chosen."""
    if not isinstance(tree, dict):
        raise ValueError(f"is a group of keys, got {tree!r}")
    errors, known = [], components.members("logger")
    for key, value in tree.items():
        if dataclasses.is_dataclass(value) or (isinstance(value, dict) and "name" in value):
            continue
        kinds = {one: components.kind_of("logger", path) for one, path in known.items()}
        owners = [one for one, kind in kinds.items() if key in kind.__pydantic_fields__]
        text = f"no such key or logger; {closest(key, known)}"
        if key in known:
            text = f"is not chosen; add logger={key}, or logger=[tensorboard,{key}] for both"
        elif owners and key != "name":
            text = f"no such key; did you mean logger.{owners[0]}.{key}?"
        errors.append((key, text))
    if errors:
        raise located(errors)
    return tree


if TYPE_CHECKING:

    class Component:
        """The settings of a group's member: its import path, and what its constructor takes."""

        name: str

        def __getattr__(self, key: str) -> Any: ...

    Env = Geometry = Learner = Curriculum = Logger = Agent = Opponents = Component
else:
    Env, Geometry, Learner, Curriculum, Logger = map(_group, components.CHOSEN)
    Agent, Opponents = map(_group, components.SINGLE)
#: {label: settings}, such as {"wandb": ...}
Loggers = Annotated[dict[str, Logger], BeforeValidator(_chosen_loggers)]


def missing_sources(tree: "Config") -> list[tuple[str, str]]:
    """Returns [(key, sentence)] of files and parts of a mix that are named in nested dicts and do
    not exist.
    """
    match tree.get("geometry"):
        case {"name": components.FILES, "path": str(path)} if not os.path.isfile(path):
            return [("geometry.path", f"there is no file {path!r}; give an .npz of geometries")]
        case {"name": components.SUITE, "plans": str(path)} if not os.path.isfile(path):
            return [("geometry.plans", f"there is no file {path!r}; give an .npz of floor plans")]
        case {"name": components.MIXED | components.SUITE, "parts": dict(parts)}:
            try:
                import_object(components.CHECK_PARTS)(parts)
            except ValueError as error:
                return [("geometry.parts", str(error))]
    return []


def _fields(cfg: "Train") -> Iterator[tuple[str, Any, Any]]:
    """Yields (key, field, value) of the settings of the learner and the environment."""
    for prefix, part in (("learner", cfg.learner), ("env", cfg.env)):
        for name, field in part.__pydantic_fields__.items():
            yield f"{prefix}.{name}", field, getattr(part, name)


def _bounds(field) -> Scheduled | None:
    """Returns the bounds of a setting that may be a schedule, None of any other."""
    return next((extra for extra in field.metadata if isinstance(extra, Scheduled)), None)


def schedules_of(cfg: "Train") -> list[str]:
    """Returns the keys of settings that have a schedule."""
    fields = [*_fields(cfg)]
    for item in cfg.env.wrappers:
        if isinstance(item, dict):
            wrapper = components.wrapper_settings(item)
            fields += [
                ("env.wrappers", field, getattr(wrapper, name))
                for name, field in wrapper.__pydantic_fields__.items()
            ]
    return [k for k, field, value in fields if _bounds(field) and not isinstance(value, float)]


def variable(cfg: "Train") -> dict[str, Scheduled]:
    """Returns the bounds of the settings that may vary between the members of a population, by key:
    those that may be schedules.
    """
    return {key: bounds for key, field, _ in _fields(cfg) if (bounds := _bounds(field))}


def _population_conflicts(cfg: "Train") -> Iterator[tuple[str, str]]:
    chosen, bounds, is_many = cfg.population, variable(cfg), cfg.population.size > 1
    for key, one in chosen.vary.items():
        problem = one.problem()
        if key not in bounds:
            problem = f"cannot vary; {closest(key, bounds)}"
        elif key in schedules_of(cfg):
            problem = f"is a schedule, {getattr(cfg.learner, key[8:], '')}, and so cannot vary"
        elif key == "learner.lr" and getattr(cfg.learner, "desired_kl", None) is not None:
            problem = "follows learner.desired_kl, and so cannot vary"
        elif not problem:
            try:
                for number in one.ends():
                    bounds[key].check(number)
            except ValueError as error:
                problem = str(error)
        if problem:
            yield "population.vary", f"{key} {problem}"
            break
    if chosen.schedule is not None:
        if is_many:
            text = "is of a single agent, and cannot be combined with population.size"
            yield "population.schedule", text
        elif not os.path.isfile(chosen.schedule):
            text = f"there is no file {chosen.schedule!r}; give RUN/population.jsonl"
            yield "population.schedule", text
    if not is_many:
        if chosen.vary:
            text = "is 1, and population.vary needs several members: population.size=8"
            yield "population.size", text
        return
    is_in_samples = cfg.evaluation.every is not None and not isinstance(cfg.evaluation.every, str)
    if chosen.score == "evaluated" and not is_in_samples:
        text = "is evaluated, which needs evaluations every so many samples: evaluation.every=10M"
        yield "population.score", text
    if isinstance(cfg.ranks, int) and cfg.ranks > chosen.size:
        text = f"is more than population.size={chosen.size}; each rank needs a member"
        yield "ranks", f"{cfg.ranks} {text}"
    if cfg.resume == "auto":
        yield "resume", "cannot be auto for a population yet; give resume=RUN, its folder"


def changes_lr(learner: "Learner") -> bool:
    """Returns whether the learning rate has a schedule, or follows the KL divergence."""
    is_constant = isinstance(getattr(learner, "lr", 0.0), (int, float))
    return not is_constant or getattr(learner, "desired_kl", None) is not None


# ---- Scripts ----


@frozen
class Common:
    """Settings of every script."""

    seed: Annotated[int, Field(ge=0, lt=2**63)]
    device: Annotated[str, AfterValidator(_device)]
    trust: bool = False  # import what checkpoints that others made name

    def conflicts(self) -> Iterator[tuple[str, str]]:
        """Yields (dotted key, sentence) of settings that contradict each other."""
        yield from ()

    @model_validator(mode="after")
    def _agree(self) -> "Self":
        if errors := [*self.conflicts()]:
            raise located(errors)
        return self


@frozen
class Finish:
    """What follows training."""

    evaluate: bool
    episodes: Count
    record: bool
    steps: Steps
    report: bool = False


@frozen
class Logging:
    """How often metrics are written, and how many updates are profiled."""

    every: Count = 100
    profile: Annotated[int, Field(ge=0, le=1000)] = 0


@frozen
class Evaluation:
    """Evaluations while training."""

    every: Annotated[int | float | str, AfterValidator(_every)] | None = None
    episodes: Count = 128
    stop: dict[str, Annotated[float, Field(allow_inf_nan=False)]] = dataclasses.field(
        default_factory=dict
    )


@frozen
class Checkpoints:
    """When checkpoints are saved, and how many are kept."""

    seconds: Seconds = 30.0
    keep: Annotated[int, Field(ge=2, le=1000)] = 2
    replay_every: Count = 20
    snapshots: Annotated[int, Field(ge=0, le=1000)] = 0


@frozen
class Population:
    """Agents that train at once, and take over from each other."""

    size: Annotated[int, Field(ge=1, le=1024)] = 1
    every: Samples = 20_000_000
    vary: dict[str, Variation] = dataclasses.field(default_factory=dict)
    exploit: Literal["truncation", "tournament"] = "truncation"
    explore: Literal["factor", "resample"] = "factor"
    score: str = "running"
    schedule: str | None = None
    member: int | None = None


@frozen
class Train(Common):
    env: Env
    geometry: Geometry
    agent: Agent = dataclasses.field(
        default_factory=functools.partial(components.settings_for, "agent")
    )
    learner: Learner
    curriculum: Curriculum = cast("Curriculum", components.NoCurriculum(name="none"))
    opponents: Opponents = dataclasses.field(
        default_factory=functools.partial(components.settings_for, "opponents")
    )
    population: Population = Population()
    logger: Loggers = dataclasses.field(default_factory=dict)
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
    ranks: Annotated[int | str, AfterValidator(_ranks)] = 1
    restarts: Annotated[int, Field(ge=0, le=1000)] = 0
    dry_run: bool = False
    folder: str | None
    resume: str | None
    rerun: str | None = None
    init: str | None
    member: Member = None

    def conflicts(self) -> Iterator[tuple[str, str]]:
        env, learner, over = self.env, self.learner, self.learner.anneal
        lag = getattr(learner, "lag", 0)
        # classes of users are asked when they are made
        draws = getattr(env, "resample", not env.name.startswith("megastep."))
        if self.curriculum.name != "none" and lag:
            text = "the homes to draw change with every update, so nothing can be collected ahead"
            yield "curriculum", f"{text} of it; use learner.lag=0"
        elif self.curriculum.name != "none" and not draws:
            cure = "use env.resample=true" if hasattr(env, "resample") else "use curriculum=none"
            yield "curriculum", f"env={env_name(env)} draws no home for each episode; {cure}"
        for key, field, value in _fields(self):
            for limit in (extra for extra in field.metadata if isinstance(extra, AtMost)):
                if value > (most := operator.attrgetter(limit.key)(self)):
                    yield key, f"{value} is more than {limit.key}={most}"
        if self.opponents.league and self.population.size == 1:
            text = "are other members of a population, which needs population.size=2 or more"
            yield "opponents.league", text
        if lag and (self.opponents.past or self.opponents.bot or self.opponents.league):
            text = "opponents change with every update, so nothing can be collected ahead of it"
            yield "learner.lag", f"{text}; use learner.lag=0, or no opponents"
        if over in ("samples", "seconds") and getattr(self, over) is None:
            text = f"is {over}, and no {over}= is given for the learning rate to fall over"
            yield "learner.anneal", text
        elif over in ("samples", "seconds") and changes_lr(learner):
            text = "but learner.lr is a schedule or follows learner.desired_kl"
            yield "learner.anneal", f"is {over}, {text}; leave learner.anneal out"
        if (self.samples, self.seconds, self.rerun, self.resume) == (None,) * 4:
            for key in dict.fromkeys(schedules_of(self)):
                yield key, "is a schedule over the budget; give samples= or seconds="
        for name in ("samples", "seconds"):
            if self.resume is None and getattr(self, f"more_{name}") is not None:
                text = f"extends a resumed run; give resume=RUN, or {name}= for a new run"
                yield f"more_{name}", text
        yield from _population_conflicts(self)
        if self.member is not None and self.init is None:
            yield "member", "is of a population whose weights start a run; give init=RUN"
        if self.evaluation.stop and self.evaluation.every is None:
            text = "needs evaluations in training to reach it: give evaluation.every=60s, or 1M"
            yield "evaluation.stop", text
        budgets = self.samples, self.seconds, self.more_samples, self.more_seconds
        if self.checkpoints.snapshots and not any(budgets):
            text = "are spread over the budget; give samples= or seconds="
            yield "checkpoints.snapshots", text


@frozen
class Trained:
    """What a trained agent needs to play: it has neither a learner nor loggers, whose classes may
    not be here.
    """

    seed: int
    env: Env
    geometry: Geometry
    agent: Agent
    opponents: Opponents = dataclasses.field(
        default_factory=functools.partial(components.settings_for, "opponents")
    )


@frozen
class Played(Common):
    """Settings of what plays with a trained agent."""

    env: Env | None = None
    geometry: Geometry | None = None
    split: Split
    greedy: bool
    member: Member = None


def _given(run: T | None) -> T:
    if run is None:
        raise ValueError("is missing; run=latest takes the newest run, run=FOLDER another one")
    return run


def _players(names: object) -> object:
    """Returns the names of `baseline=`: `true` is random actions; `false` and `none` are nobody."""
    if isinstance(names, bool) or names in (None, "none"):
        return ("random",) * (names is True)
    names = [names] if isinstance(names, str) else names
    return tuple(names) if isinstance(names, list) else names


@frozen
class Evaluate(Played):
    run: Annotated[str, BeforeValidator(_given)]
    episodes: Count
    max_steps: Count | None = None  # None: the environment's own limit
    baseline: Annotated[tuple[str, ...], BeforeValidator(_players)]
    against: Names | None = None
    ratings: bool = False


Home = Annotated[int, Field(ge=0, le=1_000_000)]


@frozen
class Record(Played):
    run: str | None
    runs: Annotated[tuple[str, ...], Field(min_length=2, max_length=9)] | None = None
    steps: Steps
    home: Home | None
    homes: Annotated[tuple[Home, ...], Field(min_length=1, max_length=16)] | None = None
    worst: Annotated[int, Field(ge=1, le=16)] | None = None
    episode: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    against: str | None = None
    file: str | None
    title: str | None = None
    theme: Literal["light", "dark"] = "light"
    dpi: Annotated[float, Field(ge=20, le=400)] = 100.0
    speed: Annotated[float, Field(gt=0, le=100)] = 1.0
    trail: Annotated[int, Field(ge=0, le=10_000)] = 60
    axes: bool = False

    def conflicts(self) -> Iterator[tuple[str, str]]:
        has_run, has_env = self.run is not None or self.runs is not None, self.env is not None
        stored = [name for name in ("worst", "episode") if getattr(self, name) is not None]
        if not (has_run or has_env):
            yield "run", "is missing; without a run, env=explorer records random actions"
        if has_run and has_env and not stored:
            yield "env", "cannot be combined with run, which has its own"
        if self.runs is not None and self.run is not None:
            yield "runs", "cannot be combined with run; list all runs in runs"
        elif self.runs is not None and self.homes is not None:
            yield "runs", "cannot be combined with homes; choose one home="
        if self.file is not None and not self.file.endswith(FILMS):
            text = "is neither a film, .mp4 or .gif, nor its last frame, .png, .svg or .pdf"
            yield "file", f"{self.file!r} {text}"
        if self.against is not None and self.run is None:
            yield "against", "needs run=, the agent that plays against it"
        if len(stored) == 2:
            yield "episode", "cannot be combined with worst"
        for name in stored:
            if self.run is None:
                yield name, "needs run=, whose newest evaluation it is about"
        for name in ("geometry", "homes", "against", "env") if stored else ():
            if getattr(self, name) is not None:
                yield name, f"cannot be combined with {stored[0]}, whose evaluation has its own"
