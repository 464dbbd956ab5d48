"""Protocols of the learner's parts, and the defaults of what is optional. Any object with these
attributes will do; :mod:`megastep.agents.algorithms.learner` has the rules. T steps, B lanes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

from megastep.types import Env, PolicyLike

if TYPE_CHECKING:  # commands begin without PyTorch
    import torch

    from megastep.coefficients import Coefficients

#: What an object saves: tensors and plain values by name, in nested dicts and lists.
StateDict = dict[str, Any]
#: The settings of a run as nested dicts, as config.yaml holds them.
Config = dict[str, Any]
#: Numbers and texts by name: a row of a table, or of a file of JSON Lines.
Row = dict[str, Any]
#: Number of entries, their mean and their variance; () or, for several quantities, mean and
#: variance of one shape.
Moments = tuple["torch.Tensor", "torch.Tensor", "torch.Tensor"]
T = TypeVar("T")


class Actor(PolicyLike, Protocol):
    """A policy as :func:`megastep.agents.storage.collector.collect` runs it. If the rollout stores
    values, it also needs `value(features, privileged)`, and its decisions `features`.
    """

    def compute_dtype(self) -> torch.autocast:
        """Returns the autocast context in which the actor runs."""
        ...


class RolloutLike(Protocol):
    """T steps of B lanes. Row t of a (T, B) tensor is the outcome of the action taken at time t, as
    reported by the next world.
    """

    n_steps: int  # T
    n_lanes: int  # B
    reward: torch.Tensor  # (T, B)
    terminal: torch.Tensor  # (T, B) bool
    truncated: torch.Tensor  # (T, B) bool
    learns: torch.Tensor  # (T+1, B) bool: transitions to learn from
    learners: torch.Tensor | None  # bool per lane of the environment: True if stored; None: all

    @property
    def reset(self) -> torch.Tensor:
        """(T, B) bool: the action was ignored because an episode started."""
        ...

    @property
    def metrics(self) -> Mapping[str, torch.Tensor]:
        """(T, B) each, read where an episode ends."""
        ...

    def floats(self) -> dict[str, torch.Tensor]:
        """Returns the float tensors by name, (T, B, ...) or (T+1, B, ...), to check them."""
        ...


class CollectorLike(Protocol):
    """Acts in an environment and stores what happened. `CollectorOptions` has what is optional."""

    @property
    def rollout(self) -> RolloutLike:
        """What the last call returned; allocated and empty before the first call."""
        ...

    def __call__(self) -> RolloutLike:
        """Takes T steps in every lane and returns them."""
        ...


class CollectorOptions(Protocol):
    """What a collector may have besides `CollectorLike`, with the defaults.

    Attributes:
        allocate_layouts: has rollouts hold `layouts`, (T, B) int32, from then on, for statistics by
            the source of floor plans. None: they hold none.
    """

    allocate_layouts: Callable[[], None] | None = None

    @staticmethod
    def state_dict() -> StateDict:
        """Returns all that it carries from rollout to rollout. Empty: resumed runs begin anew."""
        return {}

    @staticmethod
    def load_state_dict(state: StateDict) -> None:
        """Continues from a `state_dict`."""


@runtime_checkable
class Learner(Protocol):
    """Improves a policy: ``rollout = collect()``, ``losses = learner.update(rollout)``, repeat."""

    lr: float  # initial learning rate

    def collector(self, env: Env) -> CollectorLike:
        """Returns a collector for `env`."""
        ...

    def update(self, rollout: RolloutLike) -> dict[str, torch.Tensor]:
        """Learns from a rollout and returns metrics, tensors () or numbers by name."""
        ...

    def state_dict(self) -> StateDict:
        """Returns everything that changes, except the policy's weights."""
        ...

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`."""


class LearnerOptions(Protocol):
    """What a learner may have besides `Learner`, with the defaults.

    Attributes:
        set_lr: changes the learning rate. None: the rate is constant.
        check: a `NonFiniteCheck` that `update` calls. None: nothing is checked.
        replay_buffer: what `collector` allocates to replay from, with state_dict() and
            load_state_dict(state). Checkpoints hold it where it is small enough.
        n_steps: T, for `dry_run=true`.
        n_minibatches: minibatches of an update, for the same.
        coefficients: the `megastep.coefficients.Coefficients` that it uses, which follow their
            schedules. None: it has none.
        warmup: updates over which the learning rate rises to the initial one.
        read_lr: reads the learning rate, if the learner changes it itself.
        extra: parameters that it trains besides the policy's.
        copy_from: takes over, in place, what another learner of its class has learnt, the policy's
            weights included. None: it cannot be a member of a population.
    """

    set_lr: Callable[[float], None] | None = None
    check: Any = None
    replay_buffer: Any = None
    n_steps: int | None = None
    n_minibatches: int | None = None
    coefficients: Coefficients | None = None
    warmup: int = 0
    read_lr: Callable[[], float] | None = None
    extra: Sequence[torch.Tensor] = ()
    copy_from: Callable[[Learner], None] | None = None

    @staticmethod
    def bytes_per_env(env: Env) -> float:
        """Returns the bytes needed per environment like `env`, rollouts included."""
        return 0.0

    @staticmethod
    def replay_size(env: Env) -> tuple[int, float]:
        """Returns the number of observations that a replay buffer will hold, and bytes of each."""
        return 0, 0.0


def with_defaults(owner: object, options: type[T]) -> T:
    """Returns the attributes of `options`, a protocol with defaults, as `owner` has them."""
    names = (name for name in vars(options) if not name.startswith("_"))
    values = {name: getattr(owner, name, getattr(options, name)) for name in names}
    return cast(T, SimpleNamespace(**values))


class Logger(Protocol):
    """What `logger=module:Class` names.

    Its constructor takes those that it wants of `folder`, the run folder, a Path; `step`, the
    environment steps at which the run starts; `run_name`, the folder's name; and `config`, the
    run's settings. Its other arguments are settings. One that raises is dropped with a warning.
    """

    def write(self, step: int, values: Mapping[str, float | str]) -> None:
        """Writes one report after ``step`` environment steps: metrics, rates and times by name."""

    def close(self) -> None:
        """Writes what is buffered and closes files and connections."""


class RunResult(NamedTuple):
    """What a logger that has a method `finish(step, result)` gets at the end of a run that was not
    interrupted. It is made anew for that, with the number of samples as `step`.
    """

    numbers: dict[str, float]  # the final ones by name, such as `score`, the last mean return
    film: Path | None = None  # path of the video
    table: Sequence[Mapping[str, str]] = ()  # rows of the evaluation: texts by column
