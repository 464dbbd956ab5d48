"""The settings of a run as frozen dataclasses, each value with its bounds. Knows no Hydra. Defaults
are those of configs/, but for environments, whose constructors have them.
"""

import dataclasses
import inspect
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from agents.cli.checks import above, among, bounded_by, device_name, within
from megastep import envs
from megastep.bounds import MAX_ENVS, bounds_of

Sentences = Iterator[tuple[str, str]]
#: Arguments of an environment that a run gives it from other settings.
FROM_RUN = ("self", "geometries", "seed", "device", "privileged")


def of_environment(constructor: Callable) -> type:
    """A dataclass of an environment's settings: `name`, and the arguments of its constructor with
    the types, bounds and defaults that they have there.
    """
    hints, bounds = typing.get_type_hints(constructor), bounds_of(constructor)
    fields = [("name", str)]
    for name, argument in inspect.signature(constructor).parameters.items():
        if name not in FROM_RUN:
            kind = hints.get(name, type(argument.default))
            fields.append((name, kind, bounded_by(bounds.get(name), argument.default)))
    return dataclasses.make_dataclass("Env", fields, frozen=True)


ENVS = {name: of_environment(env.__init__) for name, env in envs.ENVS.items()}
Env = typing.Union[tuple(ENVS.values())]  # noqa: UP007


@dataclass(frozen=True)
class Toy:
    """A source of one geometry."""

    name: str
    n: typing.ClassVar[int] = 1
    seed: typing.ClassVar[int] = 1
    options: typing.ClassVar[dict] = {}


@dataclass(frozen=True)
class Homes:
    """A source of at most `n` homes of a split, in an order that `seed` gives: arguments of
    `geometries.sample`. `options` are those it takes beside n, split and seed.
    """

    name: str
    n: int = within(1, 1_000_000)
    seed: int = within(0, 2**63 - 1)
    options: typing.ClassVar[dict] = {}


@dataclass(frozen=True)
class Files:
    """As `Homes`, from the file `path`."""

    name: str
    n: int = within(1, 1_000_000)
    seed: int = within(0, 2**63 - 1)
    path: str | None

    def errors(self) -> Sentences:
        if self.path is None:
            yield "path", "is missing: geometry=files needs geometry.path=FILE.npz"

    @property
    def options(self) -> dict:
        return {"path": self.path}


Geometry = Toy | Homes | Files
GEOMETRIES = {"box": Toy, "column": Toy, "homes": Homes, "bench": Homes, "files": Files}


@dataclass(frozen=True)
class Agent:
    """Arguments of `agents.policy.Policy`."""

    width: int = within(1, 8192)
    encoder: str = among("linear", "conv")
    critic: str = among("asymmetric", "plain")


@dataclass(frozen=True)
class Learner:
    """Arguments of `agents.ppo.PPO`, and the rollout's length."""

    name: str = among("ppo")
    n_steps: int = within(1, 65_536)
    lr: float = within(0, 1e6, min_open=True)
    anneal: str = among("auto", "never", "samples", "seconds")
    gamma: float = within(0, 1)
    lambda_: float = within(0, 1)
    clip: float = within(0, 1e6, min_open=True)
    entropy_coef: float = within(0, 1e6)
    value_coef: float = within(0, 1e6)
    auxiliary_coef: float = within(0, 1e6)
    max_grad_norm: float = within(0, 1e6, min_open=True)
    n_epochs: int = within(1, 1000)
    n_minibatches: int = within(1, MAX_ENVS)
    target_kl: float | None = within(0, 1e6, min_open=True)


@dataclass(frozen=True)
class LocalLogger:
    """Metrics go to TensorBoard and JSON lines, which are always written."""

    name: str


@dataclass(frozen=True)
class WandbLogger:
    """They go to Weights & Biases as well."""

    name: str
    project: str
    mode: str = among("online", "offline")


LOGGERS = {"none": LocalLogger, "wandb": WandbLogger}
#: Groups whose member, by its name, decides which settings there are.
VARIANTS = (ENVS, GEOMETRIES, LOGGERS)


@dataclass(frozen=True)
class Finish:
    """What happens to the trained agent at the end of a run."""

    evaluate: bool
    lanes: int = within(1, 1_000_000)
    record: bool
    steps: int = within(1, 100_000)


@dataclass(frozen=True)
class Train:
    """A training run."""

    env: Env
    geometry: Geometry
    agent: Agent
    learner: Learner
    logger: LocalLogger | WandbLogger
    finish: Finish
    seed: int = within(0, 2**63 - 1)
    device: str = device_name()
    samples: int | None = within(1, 10**18)
    seconds: float | None = above(0)
    report: int = within(1, 1_000_000)
    checkpoint: float = above(0)
    keep: int = within(2, 1000)
    folder: str | None
    resume: str | None
    init: str | None

    def errors(self) -> Sentences:
        parts, n_envs = self.learner.n_minibatches, self.env.n_envs
        if parts > n_envs:
            yield "learner.n_minibatches", f"{parts} is more than env.n_envs, {n_envs}"
        over = self.learner.anneal
        if over in ("samples", "seconds") and getattr(self, over) is None:
            yield "learner.anneal", f"is {over}: lr falls over {over}, which are not given"
        if self.resume and self.init:
            yield (
                "init",
                "cannot be given together with resume: one starts a new run, the other continues "
                "one",
            )


@dataclass(frozen=True)
class Evaluate:
    """An evaluation of a run's checkpoint."""

    run: str
    geometry: Geometry | None
    split: str = among("training", "test", "all")
    lanes: int = within(1, 1_000_000)
    greedy: bool
    baseline: bool
    seed: int = within(0, 2**63 - 1)
    device: str = device_name()


@dataclass(frozen=True)
class Record:
    """A video of a run's checkpoint."""

    run: str
    geometry: Geometry | None
    split: str = among("training", "test", "all")
    steps: int = within(1, 100_000)
    home: int = within(0, 1_000_000)
    greedy: bool
    seed: int = within(0, 2**63 - 1)
    device: str = device_name()
    file: str | None
