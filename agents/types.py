"""What a learner, a collector and a logger have, as protocols for type checkers and readers.

Nothing inherits from them; any object with these attributes will do. T steps, B lanes.
"""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import torch

from megastep.types import Env

__all__ = ["Collector", "Learner", "Logger"]


class Collector(Protocol):
    """Acts in an environment and stores what happened. Owned by the learner that made it."""

    rollout: Any  # the rollout that the last call returned

    def __call__(self) -> Any:
        """Takes T steps in every lane and returns them as a rollout."""


@runtime_checkable
class Learner(Protocol):
    """Improves a policy: ``rollout = collect(); losses = learner.update(rollout)``, for ever.

    :mod:`megastep.agents.algorithms.learner` says what each part must do.
    """

    lr: float
    check: Any  # a NonFiniteCheck

    def collector(self, env: Env) -> Collector: ...

    def update(self, rollout: Any) -> dict[str, torch.Tensor]: ...

    def bytes_per_env(self, env: Env) -> float: ...

    def set_lr(self, lr: float) -> None: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None: ...


class Logger(Protocol):
    """Writes the numbers of a run."""

    def write(
        self, step: int, metrics: Mapping[str, float | str], perf: Mapping[str, float]
    ) -> None:
        """Writes one report after ``step`` environment steps."""

    def close(self) -> None: ...
