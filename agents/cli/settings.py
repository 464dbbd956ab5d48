"""The settings of the scripts as frozen dataclasses, checked by their annotations. Knows no Hydra.

configs/ holds the defaults of a run. The settings of environments, geometries, learners, agents and
opponents are the arguments of their constructors, with the bounds and defaults given there.
"""

import dataclasses
import functools
import inspect
import json
import re
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, TypeAdapter, model_validator

from megastep.agents.imports import import_object
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay.opponents import Opponents
from megastep.settings import closest, frozen, located, settings_of

Above0 = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Steps = Annotated[int, Field(ge=1, le=100_000)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Split = Literal["training", "test", "all"]


def _device(name: str) -> str:
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", name):
        raise ValueError(f"{name!r} is no device; use auto, cpu, cuda or cuda:<number>")
    return name


Device = Annotated[str, AfterValidator(_device)]


@frozen
class LocalLogger:
    """TensorBoard and JSON lines, which are always written."""

    name: str


@frozen
class WandbLogger:
    """Weights & Biases as well."""

    name: str
    project: str
    mode: Literal["online", "offline"]
    group: str | None = None


# ---- Groups ----


class Group(NamedTuple):
    """A group of configs/. The member that is chosen decides which settings the group has.

    A member has `name`, the import path of a class or function, whose arguments are its settings.
    """

    reserved: tuple[str, ...] = ()  # arguments that the program passes itself
    required: dict[str, str] = {}  # arguments it must take: what each means
    defaults: dict[str, Any] = {}  # for arguments without a default
    more: dict[str, Any] = {}  # settings beside the arguments
    kinds: dict[str, type] = {}  # the dataclass of each name, where names are no import paths


GROUPS = {
    "env": Group(
        reserved=("geometries", "seed", "device", "privileged"),
        required={"n_envs": "the number of environments"},
        defaults={"n_envs": 128},
    ),
    "geometry": Group(
        reserved=("split",),
        required={"n": "the number of geometries", "split": "training, test or all", "seed": "an integer"},
        defaults={"n": 512, "seed": 1},
    ),
    "learner": Group(
        reserved=("policy", "seed", "graph"),
        required={"policy": "the policy to improve"},
        # what lr falls to 0 over; auto: samples if given, else seconds if given
        more={"anneal": (Literal["auto", "never", "samples", "seconds"], "auto")},
    ),
    "logger": Group(kinds={"none": LocalLogger, "wandb": WandbLogger}),
}


@functools.cache
def kind_of(group: str, name: str) -> type:
    """Returns the dataclass of the settings of a group's member, by the member's `name`.

    Raises:
        ValueError: if nothing can be imported under this name, or it takes other arguments.
    """
    spec = GROUPS[group]
    if spec.kinds:
        if name not in spec.kinds:
            raise ValueError(f"{name!r} is unknown; {closest(name, spec.kinds)}")
        return spec.kinds[name]
    constructor = import_object(name)
    try:
        present = inspect.signature(constructor).parameters
        for argument, meaning in spec.required.items():
            if argument not in present:
                raise ValueError(f"it takes no {argument} ({meaning})")
        return settings_of(constructor, spec.reserved, spec.defaults, name=str, **spec.more)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name} cannot be used: {error}") from error


def _settings_of_group(group: str) -> Any:
    """Returns the type of a field that holds the settings of a group's member."""

    def settings(value):
        if dataclasses.is_dataclass(value):
            return value
        if not isinstance(value, dict):
            raise ValueError(f"is a group of keys, got {value!r}")
        if "name" not in value:
            raise ValueError(f"its keys need a member: give {group}= as well")
        return TypeAdapter(kind_of(group, str(value["name"]))).validate_json(json.dumps(value))

    return Annotated[Any, BeforeValidator(settings)]


def label(name: str) -> str:
    """Returns an import path in short: `explorer` for megastep.envs.explorer:Explorer."""
    return name.rpartition(":")[2].rpartition(".")[2].lower()


Env, Geometry, Learner, Logger = map(_settings_of_group, GROUPS)
Agent = settings_of(Policy, ("obs_space", "action_space", "privileged_space", "seed"))
Opposition = settings_of(
    Opponents,
    ("env", "policy", "scripted", "seed"),
    bot_class=(str, "megastep.envs.deathmatch:Bot"),
)


# ---- Scripts ----


@frozen
class Finish:
    """What follows training."""

    evaluate: bool
    episodes: Count
    record: bool
    steps: Steps


@frozen
class Train:
    """A training run."""

    env: Env
    geometry: Geometry
    agent: Agent
    learner: Learner
    opponents: Opposition = Opposition()
    logger: Logger
    finish: Finish
    seed: Seed
    device: Device
    samples: Annotated[int, Field(ge=1, le=10**18)] | None
    seconds: Above0 | None
    log_every: Count
    checkpoint_seconds: Above0
    keep_checkpoints: Annotated[int, Field(ge=2, le=1000)]
    snapshots: Annotated[int, Field(ge=0, le=1000)] = 0
    folder: str | None
    resume: str | None
    init: str | None

    @model_validator(mode="after")
    def _agrees(self):
        n_minibatches, over = getattr(self.learner, "n_minibatches", 1), self.learner.anneal
        has_opponents = self.opponents.past or self.opponents.bot
        is_endless = self.samples is None and self.seconds is None
        _refuse(
            (
                n_minibatches > self.env.n_envs,
                "learner.n_minibatches",
                f"{n_minibatches} is more than env.n_envs={self.env.n_envs}",
            ),
            (
                getattr(self.learner, "lag", 0) and has_opponents,
                "learner.lag",
                "opponents change with every update, so collecting cannot run ahead of learning; "
                "use learner.lag=0, or no opponents",
            ),
            (
                over in ("samples", "seconds") and getattr(self, over) is None,
                "learner.anneal",
                f"is {over}, and no {over}= is given for the learning rate to fall over",
            ),
            (
                self.snapshots and is_endless,
                "snapshots",
                "are spread over the budget; give samples= or seconds=",
            ),
            (
                self.resume and self.init,
                "init",
                "cannot be combined with resume: init starts a new run, resume continues one",
            ),
        )
        return self


@frozen
class Evaluate:
    """An evaluation of a run's checkpoint."""

    run: str
    env: Env | None = None
    geometry: Geometry | None = None
    split: Split
    episodes: Count
    greedy: bool
    baseline: bool
    against: tuple[str, ...] | None = None
    ratings: bool = False
    seed: Seed
    device: Device


@frozen
class Record:
    """A video of a run's checkpoint, or of random actions in an environment."""

    run: str | None
    env: Env | None = None
    geometry: Geometry | None = None
    split: Split
    steps: Steps
    home: Annotated[int, Field(ge=0, le=1_000_000)]
    greedy: bool
    against: str | None = None
    seed: Seed
    device: Device
    file: str | None

    @model_validator(mode="after")
    def _agrees(self):
        no_run = self.run is None
        _refuse(
            (
                no_run and self.env is None,
                "run",
                "is missing; without a run, env=explorer records random actions",
            ),
            (
                not no_run and self.env is not None,
                "env",
                "cannot be combined with run, which has its own",
            ),
            (
                no_run and self.env is not None and self.against is not None,
                "against",
                "needs run=, the agent that plays against it",
            ),
        )
        return self


def _refuse(*rules: tuple[Any, str, str]) -> None:
    """Raises all rules (is broken, dotted key, sentence) that are broken."""
    if errors := [(key, text) for is_broken, key, text in rules if is_broken]:
        raise located(errors)
