"""Objects that training calls at certain moments: its own parts, and those of users, of which
docs/callbacks.md has examples.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch

from megastep.agents import console
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.distributed.process_group import rank_label
from megastep.agents.errors import UserError, shortened, user_errors
from megastep.types import Env, optional

if TYPE_CHECKING:
    from megastep.agents.runs.saver import Saver
    from megastep.agents.training.trainer import Trainer

#: The methods, and what each gets beside the trainer.
HOOKS = {
    "on_start": "",
    "on_collect": "",
    "on_rollout": "the rollout",
    "on_update": "the losses, tensors of shape ()",
    "on_measure": "the metrics of a report, name -> number, to which more may be added",
    "on_report": "the metrics",
    "may_save": "",
    "on_checkpoint": "",
    "on_end": "",
}


#: Training stops after this many skipped updates in a row.
MAX_SKIPPED = 20


class Callbacks(list[Any]):
    """Calls the methods that objects have, in the order of the objects. Raises ValueError: an
    object has none of `HOOKS`.

    All ranks call them, each on objects of its own, so that what they change stays the same on all.
    """

    def __init__(self, callbacks: list[object]):
        super().__init__(callbacks)
        for one in self:
            if not any(hasattr(one, hook) for hook in HOOKS):
                hooks = ", ".join(HOOKS)
                raise ValueError(f"{type(one).__name__} is not a callback: it has none of {hooks}")

    def __call__(self, hook: str, *arguments: object) -> list[object]:
        """Calls a hook. Returns the results. UserError naming a user's callback that fails."""
        results = []
        for one in self:
            method: Callable | None = getattr(one, hook, None)
            if method is None:
                continue
            try:
                results.append(method(*arguments))
            except Exception as error:
                if isinstance(error, UserError) or type(one).__module__.startswith("megastep."):
                    raise
                problem = f"{type(error).__name__}: {shortened(error, 300)}"
                raise UserError(f"{type(one).__name__}.{hook} failed ({problem})") from error
        return results

    def close(self, env: Env) -> None:
        """Closes an environment, then the objects that have `close`."""
        close_env(env)
        for one in self:
            getattr(one, "close", lambda: None)()


def close_env(env: Env) -> None:
    """Closes an environment. Warns if that fails."""
    try:
        optional(env, "close")()
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        warnings.warn(f"The environment could not be closed: {reason}", stacklevel=2)


class Losses:
    """Reports what the last update returned, means over the ranks, without NaN."""

    losses: Mapping[str, Any] = {}

    def on_update(self, trainer: Trainer, losses: Mapping[str, Any]) -> None:
        """Keeps the losses."""
        self.losses = losses

    def on_measure(self, trainer: Trainer, metrics: dict[str, Any]) -> None:
        """Adds the losses. Synchronises."""
        device, values = trainer.env.device, [*self.losses.values()]
        if values:
            values = torch.stack([torch.as_tensor(one, device=device) for one in values]).tolist()
        metrics |= trainer.ranks.mean(dict(zip(self.losses, values, strict=True)))


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
            part, _, name = key.partition(".")
            owners = [self.options.coefficients] if part == "learner" else self.coefficients
            owner = next((x for x in owners if x is not None and name in x.values), None)
            if owner is None:
                problem = "the learner and the environment have no such number"
                raise ValueError(f"{key} cannot change while training: {problem}")
            owner.set(**{name: value})
            if key == "learner.lr":
                self.trainer.lr = self.trainer.learner.lr = value

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


class NonFiniteGuard:
    """Warns of the first NaN or infinity of a run, and ends a run whose updates are all skipped:
    the learner skips those with one, see `nonfinite.NonFiniteCheck`. Ranks exchange what they find.

    Attributes:
        value: the first NaN or infinity of the run, or None.
        tolerates_divergence: a policy that diverged is noted in `has_diverged`, and raises nothing,
            for whoever replaces it. Its updates are skipped, so its weights stay as they are.
        has_diverged: the last `MAX_SKIPPED` updates were skipped.
    """

    tolerates_divergence = has_diverged = False
    value: Any = None

    def on_report(self, trainer: Trainer, metrics: object) -> None:
        """Checks the last update."""
        self.check(trainer)

    def may_save(self, trainer: Trainer) -> bool:
        """Returns whether the last update was applied, or the policy is about to be replaced."""
        return self.tolerates_divergence or self.check(trainer)

    def check(self, trainer: Trainer) -> bool:
        """Returns whether the last update was applied. NonFiniteError: many were skipped."""
        rollout, nonfinite_check = trainer.rollout, trainer.learner_options.check
        if nonfinite_check is None:
            return True
        value, n_skipped = nonfinite_check.read(rollout.floats())
        if value:
            stored = rollout.learners  # of the environment's lanes
            lanes = range(rollout.n_lanes) if stored is None else stored.nonzero()[:, 0].tolist()
            value = value.in_env(lanes, optional(trainer.env, "n_agents"))
        is_bad = value is not None or n_skipped > 0
        reports = trainer.ranks.gather_if_any((n_skipped, value, rank_label()), is_bad)
        n_skipped = max(report[0] for report in reports)
        _, value, label = next((one for one in reports if one[1]), reports[0])
        text = f"{value}{f' ({label})' * (len(reports) > 1)}"
        if value and self.value is None:
            self.value = value
            if trainer.ranks.rank == 0:
                warnings.warn(f"{text}; its rollout was skipped", stacklevel=2)
        self.has_diverged = n_skipped >= MAX_SKIPPED
        if not self.has_diverged:
            return n_skipped == 0
        is_from_env = value is not None and value.is_from_env
        if self.tolerates_divergence and not is_from_env:
            return False
        advice = f"The policy diverged: try a learning rate smaller than {trainer.learner.lr:g}"
        if value is not None and is_from_env:
            advice = f"It came from the environment: check how it computes {value.name}"
        raise NonFiniteError(
            f"The last {n_skipped} updates were skipped because of numbers that were not finite or "
            f"too large ({text if value else 'gradients'}). {advice}",
            is_from_env,
        )


class Snapshots:
    """Saves what the policy acts with at the end of each of `n` equal parts of the budget."""

    def __init__(self, saver: Saver, n: int):
        self.saver, self.n, self.n_parts_done = saver, n, 0

    def on_start(self, trainer: Trainer) -> None:
        """Continues with the part that the run is in."""
        self.n_parts_done = int((1 - trainer.fraction_left) * self.n + 1e-9)

    def on_update(self, trainer: Trainer, losses: object) -> None:
        """Saves a snapshot if a part has ended."""
        before = self.n_parts_done
        self.on_start(trainer)
        if self.n_parts_done > before:
            self.saver(trainer.samples, trainer.run_state.of_policy(), None, False)
            self.saver.wait()


class Progress:
    """Shows a line with each report: the fraction of the budget spent, if any, and words."""

    def __init__(self, show: Callable[[float | None, list[str]], None]):
        self.show = show

    def on_report(self, trainer: Trainer, metrics: Mapping[str, Any]) -> None:
        """Shows the line."""
        left, latest = trainer.fraction_left, trainer.latest_stats
        words = [f"{console.number(trainer.samples)} samples"]
        if (rate := trainer.timing.rate) is not None:
            words.append(f"{console.number(rate)}/s")
        if "episode/return" in latest:
            n_episodes = console.number(latest["episode/window"])
            words.append(f"return {latest['episode/return']:.3g} of {n_episodes} episodes")
            stats = trainer.episodes.stats
            names = {group: f"episode/return/{group}" for group in stats.groups}
            names |= {name: f"episode/{name}" for name in stats.metrics}
            if len(names) <= 4:
                words += [f"{name} {latest[k]:.3g}" for name, k in names.items() if k in latest]
            won = [(key.partition("episode/won/")[2], rate) for key, rate in latest.items()]
            words += [f"won vs {opponent} {100 * rate:.0f} %" for opponent, rate in won if opponent]
        if "return" in trainer.evaluation:
            words.append(f"evaluated {trainer.evaluation['return']:.3g}")
        is_limited = trainer.budget.is_limited
        if is_limited and left < 1:
            words.append(f"{console.duration(trainer.clock.seconds * left / (1 - left))} left")
        self.show(1 - left if is_limited else None, words)
