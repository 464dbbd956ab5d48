"""The training loop: collect, update, log, save."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import torch

from megastep.agents.algorithms.nonfinite import NonFiniteError, NonFiniteValue, lane_name
from megastep.agents.training import nonfinite_replay
from megastep.agents.training.budget import Budget, Stopwatch
from megastep.agents.training.episode_stats import MIN_EPISODES, EpisodeStats, lane_groups
from megastep.agents.training.performance import PhaseTimer, device_memory
from megastep.agents.types import LEARNER_DEFAULTS
from megastep.types import Env, optional

if TYPE_CHECKING:
    from megastep.agents.networks.policy import Policy
    from megastep.agents.types import Learner, Logger

#: Training stops after this many skipped updates in a row.
MAX_SKIPPED = 20


class OpponentPool(Protocol):
    """The part of `selfplay.opponents.Opponents` that a trainer uses."""

    def refresh_snapshots(self, policy: Policy, n_updates: int) -> None: ...

    def pop_win_rates(self) -> dict[str, float]: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


class Trainer:
    """Trains a policy in an environment until a budget is spent.

    Args:
        env: the environment.
        policy: the policy that the learner improves.
        learner: such as `PPO`.
        logger: such as `loggers.Loggers`.
        saver: such as `saver.Saver`: called with (samples, state, score), returns True if the
            checkpoint was written.
        budget: when the run ends and how its learning rate falls.
        log_every: updates between two reports.
        checkpoint_seconds: seconds between two checkpoints.
        desync: starts the first episodes at random ages, so that not all lanes end theirs at the
            same time, if the environment has a method `desync()`. Statistics leave these episodes
            out.
        on_log: called with the trainer after each report, for example to show progress.
        opponents: `env`, if it is an `Opponents`.
        snapshot_saver: such as `saver.SnapshotSaver`: called with the trainer before the first
            update and after each.
        replay_folder: where a file is written that replays the first NaN or infinity of the
            environment, see `nonfinite_replay`; None for no file.

    Attributes:
        samples, updates: environment steps of all lanes, and updates, so far.
        clock: counts the seconds of training.
        lr: the current learning rate.
        score: the last mean return that was logged, or None before `MIN_EPISODES` have ended: that
            of few episodes is luck, and would mark the first checkpoint as the best.
        samples_per_second: speed between the last two reports, or None.
        latest_stats: name -> the last value of each episode statistic.
        nonfinite_value: the first NaN or infinity of the run, or None.
        replay_hint: how to replay it, as the rest of a sentence, or "".

    Raises:
        ValueError: the budget anneals the learning rate of a learner without `set_lr`.
    """

    def __init__(
        self,
        env: Env,
        policy: Policy,
        learner: Learner,
        logger: Logger,
        saver: Callable[[int, dict[str, Any], float | None], bool],
        budget: Budget,
        *,
        log_every: int = 1,
        checkpoint_seconds: float = 30.0,
        desync: bool = False,
        on_log: Callable[[Trainer], None] = lambda trainer: None,
        opponents: OpponentPool | None = None,
        snapshot_saver: Callable[[Trainer], None] = lambda trainer: None,
        replay_folder: Path | None = None,
    ):
        self.env, self.policy, self.learner = env, policy, learner
        self.logger, self.saver, self.budget = logger, saver, budget
        self.log_every, self.checkpoint_seconds = log_every, checkpoint_seconds
        self.on_log, self.opponents, self.snapshot_saver = on_log, opponents, snapshot_saver
        self.check = optional(learner, "check", LEARNER_DEFAULTS)
        if budget.anneal != "never" and not optional(learner, "set_lr", LEARNER_DEFAULTS):
            raise ValueError(
                f"{type(learner).__name__} has no set_lr(lr), so its learning rate cannot fall "
                f"with {budget.anneal}: use learner.anneal=never, or add the method"
            )
        self.collect = learner.collector(env)
        self.rollout = self.collect.rollout
        desync = desync and optional(env, "desync") is not None
        if desync:
            env.desync()  # the collector has reset the environment, and has not stepped it yet
        self.episode_stats = EpisodeStats(
            self.rollout.n_lanes,
            env.device,
            tuple(self.rollout.metrics),
            lane_groups(env, self.rollout.learners),
            skip_first=desync,
        )
        self.clock, self.timer = Stopwatch(), PhaseTimer(env.device)
        self.samples = self.updates = 0
        self.lr = learner.lr
        self.score = self.samples_per_second = None
        self.latest_stats = {}
        self.samples_at_log = self.updates_at_log = 0
        self.seconds_at_log = self.seconds_at_checkpoint = 0.0
        self.updates_at_checkpoint = None
        self.nonfinite_value, self.replay_hint = None, ""
        self.replay_folder, self.recorder = replay_folder, None
        if replay_folder is not None:
            self.recorder = nonfinite_replay.make_recorder(env, self.check, self.collect)

    @property
    def fraction_left(self) -> float:
        """The fraction of the budget that is left."""
        return self.budget.fraction_left(self.samples, self.clock.seconds)

    @property
    def is_saved(self) -> bool:
        """True if the last checkpoint holds every update."""
        return self.updates_at_checkpoint == self.updates

    def train(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Trains until the budget is spent or `stop()` returns True, then saves a checkpoint.

        Raises:
            NonFiniteError: training diverged, or the environment returns only NaN or infinity. The
                last good checkpoint is kept.
            Exception: any other error, after a checkpoint was saved.
        """
        try:
            self.snapshot_saver(self)
            while self.fraction_left > 0 and not stop():
                self.timer.start("collect")
                if self.recorder is not None:
                    self.recorder.start()
                self.rollout = self.collect()
                if self.recorder is not None:
                    self.recorder.end(self.rollout)
                self.timer.start("update")
                losses = self.update()
                self.timer.start("rest")
                self.snapshot_saver(self)
                if self.updates % self.log_every == 0:
                    self.log(losses)
                seconds_since = self.clock.seconds - self.seconds_at_checkpoint
                if seconds_since >= self.checkpoint_seconds and self.check_finite():
                    self.save_checkpoint()
            if self.updates > self.updates_at_log:
                self.log(losses)
            self.check_finite()
        except NonFiniteError:
            raise
        except Exception:
            with contextlib.suppress(Exception):  # the first error is the one to report
                self.save_checkpoint()
            raise
        finally:
            with contextlib.suppress(Exception):  # as above
                self.wait_for_collector()
        self.save_checkpoint()

    def wait_for_collector(self) -> None:
        """Waits until an async collector has stopped stepping the environment."""
        if hasattr(self.collect, "wait"):
            self.collect.wait()

    def update(self) -> dict[str, torch.Tensor]:
        """Learns from the current rollout. Returns the learner's metrics, tensors of shape ()."""
        rollout = self.rollout
        if self.budget.anneal != "never":
            self.lr = self.learner.lr * self.budget.lr_fraction(self.samples, self.clock.seconds)
            self.learner.set_lr(self.lr)
        losses = self.learner.update(rollout)
        self.episode_stats.add(
            rollout.reward,
            rollout.reset,
            rollout.terminal | rollout.truncated,
            rollout.learns[:-1],
            rollout.metrics,
        )
        self.samples += rollout.n_steps * rollout.n_lanes
        self.updates += 1
        if self.opponents is not None:
            self.opponents.refresh_snapshots(self.policy, self.updates)
        if not self.clock.is_running:
            if torch.device(self.env.device).type == "cuda":
                torch.cuda.synchronize(self.env.device)
            self.clock.start()
            self.seconds_at_checkpoint = self.clock.seconds
            self.samples_at_log, self.seconds_at_log = self.samples, self.clock.seconds
            self.timer.pop()
        return losses

    def log(self, losses: dict[str, torch.Tensor]) -> None:
        """Writes the metrics since the last report. Synchronises.

        A loss that is NaN has no value, as no gradient step was taken; it is left out.

        Raises the errors that `env.check()` does, and NonFiniteError as `check_finite` does.
        """
        self.wait_for_collector()
        optional(self.env, "check")()
        loss_values = [torch.as_tensor(loss, device=self.env.device) for loss in losses.values()]
        loss_values = torch.stack(loss_values).tolist() if losses else []
        loss_values = zip(losses, loss_values, strict=True)
        self.name_bad_metrics()
        stats = self.episode_stats.pop()
        if self.opponents is not None:
            stats |= self.opponents.pop_win_rates()
        self.latest_stats.update(stats)
        metrics = {
            **stats,
            **{name: value for name, value in loss_values if not math.isnan(value)},
            "updates": self.updates,
            "lr": self.lr,
            "anneal": self.budget.anneal,
        }
        seconds = self.clock.seconds
        perf = {"perf/seconds": seconds}
        if self.samples > self.samples_at_log:  # not for the first update, which compiles
            n_samples = self.samples - self.samples_at_log
            self.samples_per_second = n_samples / (seconds - self.seconds_at_log)
            perf["perf/rate"] = self.samples_per_second
            perf |= {f"perf/{phase}": time for phase, time in self.timer.pop().items()}
        perf |= {f"perf/memory_{name}": n for name, n in device_memory(self.env.device).items()}
        self.samples_at_log, self.seconds_at_log = self.samples, seconds
        self.updates_at_log = self.updates
        self.logger.write(self.samples, metrics, perf)
        if stats.get("episode/window", 0) >= MIN_EPISODES:
            self.score = stats["episode/return"]
        self.on_log(self)
        self.check_finite()

    def check_finite(self) -> bool:
        """Returns True if the last update was applied, False if it was skipped. Synchronises.

        Warns about the first NaN or infinity of the run. Without `learner.check` it does nothing.

        Raises:
            NonFiniteError: the last `MAX_SKIPPED` updates were all skipped.
        """
        if self.check is None:
            return True
        value, n_skipped = self.check.read(self.rollout.floats())
        if value:
            value = value.in_env(self.env_lanes(), optional(self.env, "n_agents"))
        if value and self.nonfinite_value is None:
            self.nonfinite_value = value
            self.write_replay(value)
            warnings.warn(f"{value}; its rollout was skipped{self.replay_hint}", stacklevel=2)
        if self.recorder is not None:
            self.recorder.forget()
        if n_skipped < MAX_SKIPPED:
            return n_skipped == 0
        advice = f"The policy diverged: try a learning rate smaller than {self.learner.lr:g}"
        if value and value.is_from_env:
            self.save_checkpoint()  # the skipped updates left the policy unchanged
            advice = f"It came from the environment: check how it computes {value.name}"
        raise NonFiniteError(
            f"The last {n_skipped} updates were skipped because of numbers that were not finite or "
            f"too large ({value or 'gradients'}). {advice}"
        )

    def env_lanes(self) -> range | list[int]:
        """Returns the environment's lane of each lane of the rollout."""
        learners = self.rollout.learners
        return (
            range(self.rollout.n_lanes) if learners is None else learners.nonzero()[:, 0].tolist()
        )

    def name_bad_metrics(self) -> None:
        """Warns once of each metric that was not finite at the end of an episode. Synchronises."""
        for name, lane in self.episode_stats.pop_bad_metrics().items():
            lane = lane_name(self.env_lanes()[lane], optional(self.env, "n_agents"))
            warnings.warn(
                f"metrics.{name} of {lane} was not finite at the end of an episode; such episodes "
                f"are left out of episode/{name}",
                stacklevel=3,
            )

    def write_replay(self, value: NonFiniteValue) -> None:
        """Writes the file that replays a number of the environment, and stops recording."""
        recorder, self.recorder = self.recorder, None
        if self.replay_folder is None or not value.is_from_env:
            return
        if recorder is None:
            self.replay_hint = nonfinite_replay.NOT_RECORDED
            return
        path = self.replay_folder / f"nonfinite-{self.samples}.npz"
        try:
            recorder.write(path, value, self.rollout)
            self.replay_hint = f". To see it again: {nonfinite_replay.command(path)}"
        except OSError as error:
            self.replay_hint = f". {path} could not be written ({error.strerror or error})"

    def save_checkpoint(self) -> None:
        """Writes a checkpoint, unless the last one holds every update."""
        self.seconds_at_checkpoint = self.clock.seconds
        if not self.is_saved and self.saver(self.samples, self.state_dict(), self.score):
            self.updates_at_checkpoint = self.updates

    def state_dict(self) -> dict[str, Any]:
        """Returns all that a resumed run needs, as plain dicts of tensors and numbers."""
        opponents = {} if self.opponents is None else {"opponents": self.opponents.state_dict()}
        return dict(
            **opponents,
            policy=self.policy.state_dict(),
            learner=self.learner.state_dict(),
            episode_stats=self.episode_stats.state_dict(),
            samples=self.samples,
            updates=self.updates,
            seconds=self.clock.seconds,
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores a `state_dict`. The environment starts new episodes."""
        self.policy.load_state_dict(state["policy"])
        self.learner.load_state_dict(state["learner"])
        self.episode_stats.load_state_dict(state["episode_stats"])
        if self.opponents is not None:
            self.opponents.load_state_dict(state["opponents"])
        self.samples, self.updates = state["samples"], state["updates"]
        self.clock.seconds_before = state["seconds"]
        self.updates_at_checkpoint = self.updates_at_log = self.updates
