"""The training loop: collect, update, report, save."""

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.distributed.ranks import Plan, Ranks, world
from megastep.agents.networks.policy import Policy
from megastep.agents.runs.saver import NOWHERE, Saver
from megastep.agents.training.budget import Budget, Stopwatch
from megastep.agents.training.callbacks import Callbacks, Losses, NonFiniteGuard, Tuning
from megastep.agents.training.episode_stats import Episodes
from megastep.agents.training.performance import Timing
from megastep.agents.training.run_state import RunState
from megastep.agents.types import Learner, LearnerOptions, StateDict, with_defaults
from megastep.types import Env, optional


class Trainer:
    """Trains a policy in an environment until a budget is spent. With several ranks, each has a
    trainer, and all do the same updates: rank 0's clock decides. Raises ValueError: the budget
    anneals the learning rate of a learner without `set_lr`.

    Args:
        env: the environment.
        policy: the policy that the learner trains.
        learner: such as `PPO`.
        budget: when the run ends and how its learning rate falls; None: when `stop()` says so.
        saver: such as `saver.Saver`; None saves nothing.
        log_every: updates between two reports.
        checkpoint_seconds: between two checkpoints. Below a second, training waits for each.
        callbacks: objects with methods of `callbacks.HOOKS`, called in this order.
        ranks: those that train this policy together; None: all that there are.

    Attributes:
        samples, updates: environment steps of all lanes of all ranks, and updates, so far.
        clock: counts the seconds of training.
        lr, lr_fraction: the learning rate, and the fraction of the budget left for this update.
        rollout, metrics: the latest rollout, and the last report.
        latest_stats, evaluation: name -> the last value of each statistic of episodes, and of each
            number that an evaluation in training measured.
        score: what checkpoints are compared by: the mean return of the last report with
            `MIN_EPISODES`, or of the last evaluation in training.
        is_save_due: a checkpoint follows the report.
        lost: what could not be restored of a resumed run, a clause each.
        samples_at_report: samples at the last report that was due; a resumed run writes the later.
        curriculum: draws the homes of new episodes; None: the environment does.
    """

    def __init__(
        self,
        env: Env,
        policy: Policy,
        learner: Learner,
        budget: Budget | None = None,
        *,
        saver: Saver | None = None,
        log_every: int = 1,
        checkpoint_seconds: float = 30.0,
        callbacks: Sequence[object] = (),
        ranks: Ranks | None = None,
    ):
        self.env, self.policy, self.learner = env, policy, learner
        self.budget = Budget() if budget is None else budget
        self.saver = Saver(NOWHERE, {}) if saver is None else saver
        self.log_every, self.checkpoint_seconds = log_every, checkpoint_seconds
        self.ranks = world() if ranks is None else ranks
        self.collect = learner.collector(env)
        self.learner_options = with_defaults(learner, LearnerOptions)  # with its replay buffer
        self.rollout: Any = self.collect.rollout
        self.clock = Stopwatch()
        self.samples = self.updates = self.samples_at_report = self.updates_at_report = 0
        self.updates_at_checkpoint, self.seconds_at_checkpoint = None, 0.0
        self.lr, self.lr_fraction = learner.lr, 1.0
        self.metrics: dict[str, Any] = {}
        self.latest_stats: dict[str, float] = {}
        self.evaluation: dict[str, float] = {}
        self.score: float | None = None
        self.is_stopped = self.is_save_due = False
        self.lost: list[str] = []
        self.curriculum: Any = None
        self.timing, self.tuning, self.episodes = Timing(env.device), Tuning(self), Episodes(self)
        self.nonfinite_guard = NonFiniteGuard()
        standard = [self.timing, self.tuning, self.episodes, Losses()]
        self.callbacks = Callbacks([*standard, *callbacks, self.nonfinite_guard])
        self.run_state = RunState(self)

    @property
    def fraction_left(self) -> float:
        """The fraction of the budget that is left."""
        return self.budget.fraction_left(self.updates, self.samples, self.clock.seconds)

    @property
    def is_saved(self) -> bool:
        """Whether the last checkpoint holds every update, once `saver.wait()` has returned."""
        return self.updates_at_checkpoint == self.updates and self.saver.error is None

    def train(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Trains until the budget is spent or `stop()` returns True, then saves a checkpoint.

        Raises:
            NonFiniteError: training diverged, or the environment returns only NaN or infinity. The
                last good checkpoint is kept.
            Exception: any other error, after a checkpoint was saved if there are no other ranks.
        """
        try:
            self.callbacks("on_start", self)
            while (plan := self.plan(stop())).goes_on:
                if plan.saves:
                    self.save()
                self.update(plan.lr_fraction)
                if self.updates % self.log_every == 0:
                    self.report()
                    if self.is_save_due:
                        self.save()
            self.finish()
        except Exception as error:
            with contextlib.suppress(Exception):  # the first error is the one to report
                self._rescue(error)
            raise
        finally:
            self.saver.wait()

    def _rescue(self, error) -> None:
        """Saves what was learnt before an error, without episodes, which may be broken."""
        if not isinstance(error, NonFiniteError) and self.ranks.n > 1:  # the others are elsewhere
            self.saver.give_up()
        elif not isinstance(error, NonFiniteError) or error.is_from_env:
            self.save(self.run_state.state_dict(has_episodes=False), is_last=True)

    def plan(self, is_stopped: bool = False, ranks: Ranks | None = None) -> Plan:
        """Returns what all ranks do next, or those that are given; a signal has stopped some."""
        self.timing.wait()
        seconds = self.clock.seconds
        seconds_since = seconds - self.seconds_at_checkpoint
        plan = Plan(
            goes_on=self.fraction_left > 0,
            saves=self.clock.is_running and seconds_since >= self.checkpoint_seconds,
            lr_fraction=self.budget.lr_fraction(self.updates, self.samples, seconds),
        )
        # a slow disk does not stop training, unless a checkpoint of each update is wanted
        is_behind = self.saver.is_writing and self.checkpoint_seconds >= 1
        return (ranks or self.ranks).agree(plan, is_stopped or self.is_stopped, is_behind)

    def update(self, lr_fraction: float = 1.0) -> None:
        """Collects a rollout and learns from it, at a fraction of the initial learning rate."""
        self.lr_fraction = lr_fraction
        self.timing.start("collect")
        self.callbacks("on_collect", self)
        self.rollout = self.collect()
        self.timing.start("update")
        self.callbacks("on_rollout", self, self.rollout)
        losses = self.learner.update(self.rollout)
        self.timing.start("rest")
        self.samples += self.rollout.n_steps * self.rollout.n_lanes * self.ranks.n
        self.updates += 1
        self.callbacks("on_update", self, losses)
        if not self.clock.is_running:
            self.start_clock()

    def start_clock(self) -> None:
        """Counts seconds from now on, as everything is compiled. Synchronises."""
        self.timing.restart(self)
        self.seconds_at_checkpoint = self.clock.seconds

    def report(self) -> None:
        """Reports what happened since the last report. Synchronises.

        Metrics:
            samples: environment steps so far, over all lanes that learn.
            updates: updates so far.
            lr: learning rate.
            anneal: what the learning rate falls with.
            schedule/NAME: a setting of the learner or the environment that has a schedule.
        """
        optional(self.env, "check")()
        self.ranks.check_drift(self.policy, self.learner_options.extra)
        if self.updates % self.log_every == 0:
            self.samples_at_report = self.samples
        self.updates_at_report, self.is_save_due = self.updates, False
        metrics: dict[str, Any] = {}
        self.callbacks("on_measure", self, metrics)
        scheduled = self.tuning.scheduled.items()
        metrics |= {f"schedule/{name}": value for name, value in scheduled if name != "lr"}
        metrics |= {"updates": self.updates, "lr": self.lr, "anneal": self.budget.anneal}
        self.metrics = metrics | {"samples": self.samples}
        self.callbacks("on_report", self, self.metrics)

    def save(self, state: StateDict | None = None, is_last: bool = False) -> None:
        """Begins to save a checkpoint, by default of now, unless the last one holds every update,
        or a callback's `may_save` returns False; the last one does not ask. All ranks call it.
        """
        self.seconds_at_checkpoint = self.clock.seconds
        if not self.ranks.any(not self.is_saved or (is_last and self.saver.lacks_replay)):
            return
        if not is_last and self.ranks.any(False in self.callbacks("may_save", self)):
            return
        self.run_state.warn_of_unreachable()
        state = self.run_state.state_dict() if state is None else state
        self.saver(self.samples, state, self.score, is_last)
        self.updates_at_checkpoint = self.updates
        self.callbacks("on_checkpoint", self)

    def finish(self) -> None:
        """Writes the last report and the last checkpoint."""
        state = self.run_state.state_dict()  # a resumed run repeats what the last report empties
        if self.updates > self.updates_at_report:
            self.report()
        self.save(state, is_last=True)
        self.saver.wait()
        self.callbacks("on_end", self)

    def end(self) -> None:
        """Ends training after the current update; all ranks do if one does."""
        self.is_stopped = True

    def close(self) -> None:
        """Closes the environment and the callbacks."""
        self.callbacks.close(self.env)
