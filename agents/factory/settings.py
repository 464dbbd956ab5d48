"""The settings of the scripts as frozen dataclasses, checked by their annotations. Knows no Hydra.

configs/ holds the defaults of a run. The settings of environments, geometries, learners, agents and
opponents are the arguments of their constructors, with the bounds and defaults given there.
"""

import copy
import dataclasses
import functools
import inspect
import json
import operator
import os
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from megastep.agents.factory import components
from megastep.agents.population.variation import Variation
from megastep.imports import import_object
from megastep.schedules import Scheduled
from megastep.settings import (
    AtMost,
    closest,
    frozen,
    located,
    parameters_of,
    sentence,
    settings_class,
    settings_of,
)

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


Callback = Annotated[str, AfterValidator(_callback)]


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


Above0 = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Steps = Annotated[int, Field(ge=1, le=100_000)]
Samples = Annotated[int, Field(ge=1, le=10**18)]
Split = Literal["training", "test", "all"]
FILMS = ".mp4", ".gif", ".png", ".svg", ".pdf"  # endings of what record.py can write


# ---- Groups ----


@frozen
class NoCurriculum:
    """Every home is drawn alike."""

    name: str


#: Groups of configs/ whose member has `name`, the import path of a class or function, and decides
#: which settings there are: its arguments. Those it must have, with what each means.
IMPORTED = {
    "env": {"n_envs": "the number of environments"},
    "geometry": {"n": "the number of geometries", "split": "its split", "seed": "an integer"},
    "learner": {"policy": "the policy to improve"},
    "curriculum": {"env": "the environment", "rollout": "the rollout"},
    "logger": {},
}
#: Methods of a group's classes.
METHODS = {"logger": ("write", "close")}


@functools.cache
def kind_of(group: str, name: str) -> type:
    """Returns the dataclass of the settings of a group's member, by the member's `name`.

    Raises:
        ValueError: if nothing can be imported under this name, or it takes other arguments.
    """
    if (group, name) == ("curriculum", "none"):
        return NoCurriculum
    if (group, name) in components.built_in():
        return settings_class(*components.built_in()[group, name])
    constructor, spec = import_object(name), components.ARGUMENTS[group]
    try:
        taken = parameters_of(constructor)
        needed = IMPORTED.get(group, {"env": "the environment inside"})
        if missing := [f"{k}, {text}" for k, text in needed.items() if k not in taken]:
            raise ValueError(f"it has no argument {missing[0]}")
        methods = METHODS.get(group, ()) if inspect.isclass(constructor) else ()
        if absent := [method for method in methods if not hasattr(constructor, method)]:
            raise ValueError(f"it has no method {absent[0]}")
        return settings_of(constructor, is_finite=False, **spec)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name} cannot be used: {error}") from error


def as_typed(kind: type[T], tree: object) -> T:
    """Returns the settings of a dataclass from nested dicts. A value keeps the type that it was
    typed with, unless an annotation asks for another: 1e6 counts as an integer, a list as a tuple.

    Raises:
        ValidationError: of pydantic.
    """
    adapter = TypeAdapter(kind)
    whole = json.loads(
        json.dumps(tree, skipkeys=True, default=repr),  # bytes of a file, which `as_tree` refuses
        parse_float=lambda text: int(float(text)) if float(text).is_integer() else float(text),
    )
    # in strict mode pydantic takes lists for tuples and strings for paths in JSON alone, whose keys
    # are strings; otherwise it keeps keys, and takes "3" and true for numbers
    adapter.validate_json(json.dumps(whole))
    return adapter.validate_python(tree, strict=False)


def _group(group: str) -> object:
    """Returns the type of a field that holds the settings of a group's member."""

    def settings(value) -> object:
        if dataclasses.is_dataclass(value):
            return value
        if not isinstance(value, dict):
            raise ValueError(f"is a group of keys, got {value!r}")
        if "name" not in value:
            raise ValueError(f"its keys need a member: give {group}= as well")
        return as_typed(kind_of(group, str(value["name"])), value)

    return Annotated[Any, BeforeValidator(settings)]


def checked_wrappers(value: object) -> tuple[object, ...]:
    """Returns the wrappers of an environment, names and dicts of `name` and settings, checked as
    far as no package is imported.

    Raises:
        ValueError: naming what is wrong.
    """
    items = [value] if isinstance(value, (str, dict)) else value
    if not isinstance(items, (list, tuple)):
        raise ValueError(f"expected a list of wrappers, got {value!r}")
    for item in items:
        name = item.get("name") if isinstance(item, dict) else item
        known = components.members("wrapper")
        if not isinstance(name, str):
            raise ValueError(f"a wrapper is a name or {{name: ..., setting: ...}}, got {item!r}")
        if ":" not in name and name not in known:
            raise ValueError(f"{name!r} is no wrapper; {closest(name, known)}, or module:Class")
        if name in known or isinstance(item, dict):
            wrapper_settings(item)
    return tuple(items)


def wrapper_settings(item: "str | dict") -> object:
    """Returns the settings of a wrapper, with the import path of its class as `name`.

    Raises:
        ValueError: they are not those of the class.
    """
    tree = {"name": item} if isinstance(item, str) else dict(item)
    label = tree["name"]
    tree["name"] = components.members("wrapper").get(label, label)
    kind = kind_of("wrapper", tree["name"])
    try:
        return as_typed(kind, tree)
    except ValidationError as error:
        (line, *_) = error.errors()
        key = str(line["loc"][0])
        fields = kind.__pydantic_fields__
        if key not in fields:
            raise ValueError(
                f"{label} has no setting {key!r}; {closest(key, fields.keys() - {'name'})}"
            ) from None
        text = sentence(line, fields[key], line["input"])
        raise ValueError(f"{label}: {key}: {text}") from None


def changed(settings: T, **changes: object) -> T:
    """Returns a copy of settings with those of the changes that it has.

    Nothing is checked again, since a stranger's default need not be what its annotation says.
    """
    result = copy.copy(settings)
    for name, value in changes.items():
        if hasattr(settings, name):
            object.__setattr__(result, name, value)  # of a frozen class
    return result


def takes_geometries(env: "Env") -> bool:
    """Returns True if the class of an environment's settings takes floor plans."""
    return components.takes_geometries(env.name)


def ignored_geometry(env: "Env | None", typed: list[str]) -> list[tuple[str, str]]:
    """Returns [(key, sentence)] of the first typed key that chooses a geometry, if the environment
    takes none. `env` may be None, that of a run.
    """
    keys = [key for key in typed if key.split(".")[0] == "geometry"]
    if not keys or env is None or takes_geometries(env):
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
    geometry = [label(cfg.geometry.name)] if takes_geometries(cfg.env) else []
    return "-".join([env_name(cfg.env), *geometry, str(cfg.seed)])


def loggers() -> dict[str, str]:
    """Returns the import paths of megastep's loggers by label."""
    return components.members("logger")


def _chosen_loggers(tree) -> dict:
    """Returns nested dicts of loggers by label. Raises for keys of loggers that were not chosen."""
    if not isinstance(tree, dict):
        raise ValueError(f"is a group of keys, got {tree!r}")
    errors, known = [], loggers()
    for key, value in tree.items():
        if dataclasses.is_dataclass(value) or (isinstance(value, dict) and "name" in value):
            continue
        owners = [one for one, path in known.items() if key in _own_settings(path)]
        text = f"no such key or logger; {closest(key, known)}"
        if key in known:
            text = f"is not chosen; add logger={key}, or logger=[tensorboard,{key}] for both"
        elif owners:
            text = f"no such key; did you mean logger.{owners[0]}.{key}?"
        errors.append((key, text))
    if errors:
        raise located(errors)
    return tree


def _own_settings(logger) -> set[str]:
    return kind_of("logger", logger).__pydantic_fields__.keys() - {"name"}


if TYPE_CHECKING:

    class Member:
        """The settings of a group's member: its import path, and what its constructor takes."""

        name: str

        def __getattr__(self, key: str) -> Any: ...

    Env = Geometry = Learner = Curriculum = Logger = Member

    class Agent(Member): ...

    class Opposition(Member): ...

else:
    Env, Geometry, Learner, Curriculum, Logger = map(_group, IMPORTED)
    Agent = kind_of("agent", components.POLICY)
    Opposition = kind_of("opponents", components.OPPONENTS)
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


def too_large(group: Any, tree: object) -> Iterator[tuple[str, str]]:
    """Yields (key, sentence) of settings of a group that exceed another setting, see `AtMost`."""
    for name, field in group.__pydantic_fields__.items():
        for limit in (extra for extra in field.metadata if isinstance(extra, AtMost)):
            value, most = getattr(group, name), operator.attrgetter(limit.key)(tree)
            if value > most:
                yield name, f"{value} is more than {limit.key}={most}"


def schedules_of(cfg: "Train") -> list[str]:
    """Returns the keys of settings that have a schedule."""
    parts: list = [("learner.", cfg.learner), ("env.", cfg.env)]
    own = (item for item in cfg.env.wrappers if isinstance(item, dict))
    parts += [("env.wrappers", wrapper_settings(item)) for item in own]
    return [
        key if key == "env.wrappers" else f"{key}{name}"
        for key, part in parts
        for name, field in part.__pydantic_fields__.items()
        if any(isinstance(extra, Scheduled) for extra in field.metadata)
        and not isinstance(getattr(part, name), float)
    ]


def variable(cfg: "Train") -> dict[str, Scheduled]:
    """Returns the bounds of the settings that may vary between the members of a population, by key:
    those that may be schedules.
    """
    parts: list = [("learner.", cfg.learner), ("env.", cfg.env)]
    return {
        f"{prefix}{name}": extra
        for prefix, part in parts
        for name, field in part.__pydantic_fields__.items()
        for extra in field.metadata
        if isinstance(extra, Scheduled)
    }


def population_errors(cfg: "Train") -> dict[str, object]:
    """Returns {dotted key: sentence} of what is wrong with a population, false for what is not."""
    chosen, bounds = cfg.population, variable(cfg)
    errors: dict[str, object] = {}
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
            errors["population.vary"] = f"{key} {problem}"
    unit = None if cfg.evaluation.every is None else every(cfg.evaluation.every)[1]
    is_many = chosen.size > 1
    return errors | {
        "population.size": not is_many
        and chosen.vary
        and "is 1, and population.vary needs several members: population.size=8",
        "population.score": is_many
        and chosen.score == "evaluated"
        and unit != "samples"
        and "is evaluated, which needs evaluations every so many samples: evaluation.every=10M",
        "population.schedule": chosen.schedule is not None
        and (
            (is_many and "is of a single agent, and cannot be combined with population.size")
            or (
                not os.path.isfile(chosen.schedule)
                and f"there is no file {chosen.schedule!r}; give RUN/population.jsonl"
            )
        ),
        "ranks": is_many
        and isinstance(cfg.ranks, int)
        and cfg.ranks > chosen.size
        and f"{cfg.ranks} is more than population.size={chosen.size}; each rank needs a member",
        "resume": is_many
        and cfg.resume == "auto"
        and "cannot be auto for a population yet; give resume=RUN, its folder",
    }


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

    def errors(self) -> Mapping[str, object]:
        # {dotted key: sentence} of settings that contradict each other, false for those that do not
        return {}

    @model_validator(mode="after")
    def _agree(self) -> "Self":
        if errors := [(key, str(text)) for key, text in self.errors().items() if text]:
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

    seconds: Above0 = 30.0
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
    agent: Agent = Agent()
    learner: Learner
    curriculum: Curriculum = cast("Curriculum", NoCurriculum(name="none"))
    opponents: Opposition = Opposition()
    population: Population = Population()
    logger: Loggers = dataclasses.field(default_factory=dict)
    finish: Finish
    samples: Samples | None
    seconds: Above0 | None
    more_samples: Samples | None = None
    more_seconds: Above0 | None = None
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
    member: int | Literal["best"] | None = None

    def errors(self) -> dict[str, object]:
        over = self.learner.anneal
        lag, env = getattr(self.learner, "lag", 0), self.env
        has_curriculum = self.curriculum.name != "none"
        opponents = self.opponents
        is_async = lag and (opponents.past or opponents.bot or opponents.league)
        is_member = self.population.size > 1
        # classes of users are asked when they are made
        draws = getattr(env, "resample", not env.name.startswith("megastep."))
        cure = "use env.resample=true" if hasattr(env, "resample") else "use curriculum=none"
        return {
            "curriculum": has_curriculum
            and (lag or not draws)
            and (
                "the homes to draw change with every update, so nothing can be collected ahead of "
                "it; use learner.lag=0"
                if lag
                else f"env={env_name(env)} draws no home for each episode; {cure}"
            ),
            **{f"learner.{name}": text for name, text in too_large(self.learner, self)},
            "opponents.league": opponents.league
            and not is_member
            and "are other members of a population, which needs population.size=2 or more",
            "learner.lag": is_async
            and "opponents change with every update, so nothing can be collected ahead of it; use "
            "learner.lag=0, or no opponents",
            "learner.anneal": over in ("samples", "seconds")
            and (
                (
                    getattr(self, over) is None
                    and f"is {over}, and no {over}= is given for the learning rate to fall over"
                )
                or (
                    changes_lr(self.learner)
                    and f"is {over}, but learner.lr is a schedule or follows learner.desired_kl; "
                    "leave learner.anneal out"
                )
            ),
            **{
                key: "is a schedule over the budget; give samples= or seconds="
                for key in schedules_of(self)
                if (self.samples, self.seconds, self.rerun, self.resume) == (None,) * 4
            },
            **{
                f"more_{name}": self.resume is None
                and getattr(self, f"more_{name}") is not None
                and f"extends a resumed run; give resume=RUN, or {name}= for a new run"
                for name in ("samples", "seconds")
            },
            **population_errors(self),
            "member": self.member is not None
            and self.init is None
            and "is of a population whose weights start a run; give init=RUN",
            "evaluation.stop": bool(self.evaluation.stop)
            and self.evaluation.every is None
            and "needs evaluations in training to reach it: give evaluation.every=60s, or samples",
            "checkpoints.snapshots": self.checkpoints.snapshots
            and not (self.samples or self.seconds or self.more_samples or self.more_seconds)
            and "are spread over the budget; give samples= or seconds=",
        }


@frozen
class Trained:
    """What a trained agent needs to play: it has neither a learner nor loggers, whose classes may
    not be here.
    """

    seed: int
    env: Env
    geometry: Geometry
    agent: Agent
    opponents: Opposition = Opposition()


@frozen
class Played(Common):
    """Settings of what plays with a trained agent."""

    env: Env | None = None
    geometry: Geometry | None = None
    split: Split
    greedy: bool
    member: int | Literal["best"] | None = None


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
    against: tuple[str, ...] | None = None
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

    def errors(self) -> dict[str, object]:
        has_run, has_env = self.run is not None or self.runs is not None, self.env is not None
        stored = [name for name in ("worst", "episode") if getattr(self, name) is not None]
        of_stored = {
            name: getattr(self, name) is not None
            and f"cannot be combined with {stored[0]}, whose evaluation has its own"
            for name in ("geometry", "homes", "against", "env")
            if stored
        }
        return {
            **{
                name: self.run is None and "needs run=, whose newest evaluation it is about"
                for name in stored
            },
            "run": not (has_run or has_env)
            and "is missing; without a run, env=explorer records random actions",
            "runs": self.runs is not None
            and (
                (self.run is not None and "cannot be combined with run; list all runs in runs")
                or (self.homes is not None and "cannot be combined with homes; choose one home=")
            ),
            "env": has_run and has_env and "cannot be combined with run, which has its own",
            "file": self.file is not None
            and not self.file.endswith(FILMS)
            and f"{self.file!r} is neither a film, .mp4 or .gif, nor its last frame, .png, .svg or "
            ".pdf",
            "against": self.against is not None
            and self.run is None
            and "needs run=, the agent that plays against it",
            **({"episode": "cannot be combined with worst"} if len(stored) == 2 else {}),
            **{name: text for name, text in of_stored.items() if text},
        }
