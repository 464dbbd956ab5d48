"""The settings of a run as frozen dataclasses, checked by their annotations. Knows no Hydra.

Defaults are those of configs/; but what a run is made of (environment, geometries, learner, agent)
has its settings, their bounds and defaults from the arguments of its constructor.
"""

import re
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from megastep.agents.cli.registry import Choice, Group
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay.opponents import Opponents
from megastep.settings import frozen, located, settings_of

Above0 = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Steps = Annotated[int, Field(ge=1, le=100_000)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Split = Literal["training", "test", "all"]


def _device(name: str) -> str:
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", name):
        raise ValueError(f"{name!r} is no device: allowed are auto, cpu, cuda and cuda:<number>")
    return name


Device = Annotated[str, AfterValidator(_device)]


@frozen
class LocalLogger:
    """Metrics go to TensorBoard and JSON lines, which are always written."""

    name: str


@frozen
class WandbLogger:
    """They go to Weights & Biases as well."""

    name: str
    project: str
    mode: Literal["online", "offline"]
    group: str | None = None


GROUPS = {
    "env": Group(
        "env",
        reserved=("geometries", "seed", "device", "privileged"),
        needed={"n_envs": "the number of its environments"},
        missing={"n_envs": 128},
    ),
    "geometry": Group(
        "geometry",
        reserved=("split",),
        needed={"n": "how many geometries", "split": "training, test or all", "seed": "a number"},
        missing={"n": 512, "seed": 1},
    ),
    "learner": Group(
        "learner",
        reserved=("policy", "seed", "graph"),
        needed={"policy": "the policy that it improves"},
        # what lr falls to 0 over; auto: samples if given, else seconds if given
        anneal=(Literal["auto", "never", "samples", "seconds"], "auto"),
    ),
    "logger": Choice("logger", {"none": LocalLogger, "wandb": WandbLogger}),
}
Env, Geometry, Learner, Logger = (
    Annotated[Any, BeforeValidator(GROUPS[key].settings)]
    for key in ("env", "geometry", "learner", "logger")
)
#: Arguments of `megastep.agents.networks.policy.Policy`.
Agent = settings_of(Policy, ("obs_space", "action_space", "privileged_space", "seed"))
#: Arguments of `megastep.agents.selfplay.opponents.Opponents`, and the import path of the scripted policy.
Opposition = settings_of(
    Opponents,
    ("env", "policy", "scripted", "seed"),
    bot_class=(str, "megastep.envs.deathmatch:Bot"),
)


@frozen
class Finish:
    """What happens to the trained agent at the end of a run."""

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
        if errors := list(self._errors()):
            raise located(errors)
        return self

    def _errors(self):
        # of learners that cut lanes into minibatches
        parts, n_envs = getattr(self.learner, "n_minibatches", 1), self.env.n_envs
        if parts > n_envs:
            yield "learner.n_minibatches", f"{parts} is more than env.n_envs, {n_envs}"
        if getattr(self.learner, "lag", 0) and (self.opponents.past or self.opponents.bot):
            yield (
                "learner.lag",
                "opponents change as the learner learns, so nobody can act ahead of it: give "
                "learner.lag=0 or no opponents",
            )
        over = self.learner.anneal
        if over in ("samples", "seconds") and getattr(self, over) is None:
            yield "learner.anneal", f"is {over}: lr falls over {over}, which are not given"
        if self.snapshots and self.samples is None and self.seconds is None:
            yield "snapshots", "they are spaced over the budget: give samples or seconds"
        if self.resume and self.init:
            yield (
                "init",
                "cannot be given together with resume: one starts a new run, the other continues "
                "one",
            )


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
        if self.run is None and self.env is None:
            raise located([("run", "is missing; without a run, env=explorer films random actions")])
        if self.run is not None and self.env is not None:
            raise located([("env", "cannot be given together with run, which has its own")])
        if self.run is None and self.against is not None:
            raise located([("against", "needs run=, who plays against it")])
        return self
