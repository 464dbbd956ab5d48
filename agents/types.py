"""Protocols of the learner's parts: Actor, Rollout, Collector, Learner, Logger, RunLogger,
Saver and OpponentPool.

Nothing has to inherit from them: any object with these attributes will do. The rules behind them
are in :mod:`megastep.agents.algorithms.learner`. T steps, B lanes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import torch

from megastep.types import Env, Policy

__all__ = [
    "LEARNER_DEFAULTS",
    "Actor",
    "Collector",
    "Learner",
    "Logger",
    "OpponentPool",
    "Rollout",
    "RunLogger",
    "Saver",
]


class Actor(Policy, Protocol):
    """A policy as :func:`megastep.agents.storage.collector.collect` runs it.

    If the rollout stores values, the actor also needs `value(features, privileged)`, and its
    decisions need `features`.
    """

    def compute_dtype(self) -> torch.autocast:
        """Returns the autocast context in which the actor runs."""


class Rollout(Protocol):
    """T steps of B lanes. Row t of a (T, B) tensor is the outcome of the action taken at time t, as
    reported by the next world.
    """

    n_steps: int  # T
    n_lanes: int  # B
    reward: torch.Tensor  # (T, B)
    reset: torch.Tensor  # (T, B) bool: the action was ignored because an episode started
    terminal: torch.Tensor  # (T, B) bool
    truncated: torch.Tensor  # (T, B) bool
    metrics: Mapping[str, torch.Tensor]  # (T, B) each, read where an episode ends
    learns: torch.Tensor  # (T+1, B) bool: transitions to learn from
    learners: torch.Tensor | None  # bool per lane of the environment: True if stored; None: all

    def floats(self) -> dict[str, torch.Tensor]:
        """Returns the float tensors by name, (T, B, ...) or (T+1, B, ...), to check them."""


class Collector(Protocol):
    """Acts in an environment and stores what happened.

    A collector that runs in the background also has `wait()`, which blocks until nothing acts in
    the environment. One with `state_dict()` and `load_state_dict(state)`, of all that it carries
    from rollout to rollout, lets a run be resumed bit for bit. One with `allocate_layouts()` has
    the environment's layouts in its rollouts from then on, `rollout.layouts`, (T, B) int32, and
    reports have statistics of episodes by the source of their floor plan.
    """

    rollout: Rollout  # what the last call returned; allocated and empty before the first call

    def __call__(self) -> Rollout:
        """Takes T steps in every lane and returns them."""


@runtime_checkable
class Learner(Protocol):
    """Improves a policy: ``rollout = collect()``, ``losses = learner.update(rollout)``, repeat.

    Optional attributes, whose defaults are in `LEARNER_DEFAULTS`:
        set_lr(lr): changes the learning rate. Without it the rate is constant.
        check: a `NonFiniteCheck` that `update` calls.
        bytes_per_env(env): the bytes needed per environment like `env`, rollouts included.
        replay_size(env): the number of observations that a replay buffer will hold, and the bytes
            that each takes.
        replay_buffer: what `collector` allocates to replay from, with state_dict() and
            load_state_dict(state). Checkpoints hold it where it is small enough.
    """

    lr: float  # initial learning rate

    def collector(self, env: Env) -> Collector:
        """Returns a collector for `env`."""

    def update(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Learns from a rollout and returns metrics, tensors () or numbers by name."""

    def state_dict(self) -> dict[str, Any]:
        """Returns everything that changes, except the policy's weights."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state_dict`."""


#: Optional attributes of a learner, with their defaults.
LEARNER_DEFAULTS: dict[str, Any] = {
    "set_lr": None,
    "check": None,
    "bytes_per_env": lambda env: 0.0,
    "replay_size": lambda env: (0, 0.0),
    "replay_buffer": None,
}


class Logger(Protocol):
    """What `logger=module:Class` names.

    Its constructor takes those that it wants of `folder`, the run folder, a Path; `step`, the
    environment steps at which a resumed run starts, 0 in others; `run_name`, the folder's name; and
    `config`, the run's settings as nested dicts. Its other arguments are settings.

    If the constructor or a method raises, the logger is dropped with a warning and the run goes on.
    """

    def write(self, step: int, values: Mapping[str, float | str]) -> None:
        """Writes one report after ``step`` environment steps: metrics, rates and times by name."""

    def close(self) -> None:
        """Writes what is buffered and closes files and connections."""


class RunLogger(Protocol):
    """Writes the metrics of a run: its JSON lines, and each logger that was chosen."""

    def write(
        self, step: int, metrics: Mapping[str, float | str] | None, perf: Mapping[str, float]
    ) -> None:
        """Writes one report after ``step`` environment steps. Without metrics, only ``perf``."""

    def sync(self) -> None:
        """Flushes to disk what resuming reads. Raises OSError if it cannot be written."""

    def close(self) -> None:
        """Writes what is buffered and closes files and connections."""


class Saver(Protocol):
    """Saves a trainer's state, possibly while training goes on."""

    error: str | None  # why the last checkpoint that was begun could not be saved
    lacks_replay: bool  # it was not due to hold the replay buffer
    is_writing: bool

    def __call__(
        self, step: int, state: dict[str, Any], score: float | None, is_last: bool
    ) -> None: ...

    def give_up(self) -> None:
        """Waits no longer for the parts of other ranks, as one has ended."""

    def wait(self) -> None:
        """Returns when everything is saved, or has failed."""


class OpponentPool(Protocol):
    """The part of `selfplay.opponents.Opponents` that a trainer uses."""

    scripted: Any  # the bot, or None

    def refresh_snapshots(self, policy: Actor, n_updates: int) -> None: ...

    def pop_win_rates(self) -> dict[str, float]: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...
