"""Settings that change while training: the learning rate, schedules, and those of populations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from megastep.agents.errors import user_errors
from megastep.types import optional

if TYPE_CHECKING:
    from megastep.agents.training.trainer import Trainer
    from megastep.coefficients import Coefficients


class Tuning:
    """Anneals the learning rate, and sets what has a schedule, of the learner and the environment,
    by a trainer's budget. ValueError if it anneals the learning rate of a learner without `set_lr`.
    """

    def __init__(self, trainer: Trainer):
        self.trainer, self.options = trainer, trainer.learner_options
        self.scheduled: dict[str, float] = {}
        of_learner, of_env = self.options.coefficients, [*optional(trainer.env, "coefficients")]
        self.coefficients = of_env if of_learner is None else [*of_env, of_learner]
        anneal = trainer.budget.anneal
        if anneal != "never" and not self.options.set_lr:
            raise ValueError(
                f"{type(trainer.learner).__name__} has no set_lr(lr), so its learning rate cannot "
                f"fall with {anneal}: use learner.anneal=never, or add the method"
            )

    def set(self, values: Mapping[str, float]) -> None:
        """Changes settings from the next update on, without waiting for the device: numbers by key,
        `learner.NAME` or `env.NAME`, of those that may be schedules. ValueError for others.
        """
        for key, value in values.items():
            self._owner(key).set(**{key.partition(".")[2]: value})
            if key == "learner.lr":
                self.trainer.lr = self.trainer.learner.lr = value

    def _owner(self, key) -> Coefficients:
        """Returns what holds a setting that may change. Raises ValueError if nothing does."""
        part, _, name = key.partition(".")
        owners = [self.options.coefficients] if part == "learner" else self.coefficients
        for one in owners:
            if one is not None and name in one.values:
                return one
        raise ValueError(
            f"{key} cannot change while training: the learner and the environment have no such "
            "number"
        )

    def on_collect(self, trainer: Trainer) -> None:
        """Sets what has a schedule. Raises UserError if a schedule of the user's fails."""
        for one in self.coefficients:
            if one.schedules:
                with user_errors("", (ValueError,)):
                    self.scheduled |= one.follow(1 - trainer.lr_fraction)

    def on_rollout(self, trainer: Trainer, rollout: object) -> None:
        """Sets the learning rate of the update, if it changes and the learner does not do so."""
        set_lr, warmup = self.options.set_lr, self.options.warmup
        is_annealed = trainer.budget.anneal != "never"
        if not set_lr or self.options.read_lr:
            return
        if is_annealed or warmup or "lr" in self.scheduled:
            lr = self.scheduled.get("lr", trainer.learner.lr)
            lr *= trainer.lr_fraction if is_annealed else 1
            if trainer.updates < warmup:
                lr *= (trainer.updates + 1) / warmup
            trainer.lr = lr
            set_lr(lr)

    def on_measure(self, trainer: Trainer, metrics: dict[str, Any]) -> None:
        """Reads the learning rate where the learner changes it."""
        if self.options.read_lr:
            trainer.lr = self.options.read_lr()
