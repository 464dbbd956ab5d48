"""The training loop: collect, update, report, save."""

import contextlib
import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import torch

from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.training.budget import Budget, Stopwatch
from megastep.agents.training.episode_stats import EpisodeStats, lane_groups

#: So many skipped updates in a row end a run.
MAX_SKIPPED = 20


class Trainer:
    """Improves a policy in an environment until a budget is spent.

    Args:
    env, policy  the environment, and who acts in it
    learner      what improves the policy, as `megastep.agents.algorithms.learner` describes it
    metrics      has `write(samples, metrics, perf)`: `megastep.agents.training.loggers.Loggers`
    save         called with (samples, state, score); returns whether it could: a `Saver`
    budget       when to end, and how the learning rate falls
    report_every, save_every  updates between two reports, and seconds between two checkpoints
    on_report    called with the trainer after each report, to show how far it is
    opponents    the environment, where it is `opponents.Opponents`
    snapshots    called with the trainer before the first update and after each: `saver.Snapshots`
    """

    def __init__(
        self,
        env: Any,
        policy: Any,
        learner: Any,
        metrics: Any,
        save: Callable[[int, dict, float | None], bool],
        budget: Budget,
        *,
        report_every: int = 1,
        save_every: float = 30.0,
        on_report: Callable[["Trainer"], None] = lambda trainer: None,
        opponents: Any = None,
        snapshots: Callable[["Trainer"], None] = lambda trainer: None,
    ):
        self.env, self.policy, self.learner = env, policy, learner
        self.metrics, self.save_checkpoint, self.budget = metrics, save, budget
        self.report_every, self.save_every, self.on_report = report_every, save_every, on_report
        self.opponents, self.snapshots = opponents, snapshots
        self.collect = learner.collector(env)
        self.rollout = self.collect.rollout  # what was collected last
        self.episode_stats = EpisodeStats(
            self.rollout.n_lanes,
            env.device,
            tuple(self.rollout.metrics),
            lane_groups(env, self.rollout.learners),
        )
        self.clock = Stopwatch()
        self.samples = self.updates = 0
        self.lr = learner.lr
        self.score = self.rate = None  # the last reported return, and samples per second
        self.latest = {}  # of episodes, by name, when the last ones ended
        self.reported_at = 0, 0.0  # samples and seconds
        self.saved_at = 0.0  # seconds
        self.saved_updates = None  # updates that the last checkpoint holds
        self.nonfinite_value = None  # the first one that was not finite

    @property
    def left(self) -> float:
        """The fraction of the budget that is left."""
        return self.budget.left(self.samples, self.clock.seconds)

    @property
    def is_saved(self) -> bool:
        """Whether a checkpoint holds all that was learnt."""
        return self.saved_updates == self.updates

    def train(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Runs until the budget is spent or `stop()`. An error ends it too, once all that was
        learnt is saved; so does NonFiniteError, of which only what came before it is saved.
        """
        try:
            self.snapshots(self)
            while self.left > 0 and not stop():
                self.rollout = self.collect()
                losses = self.update()
                self.snapshots(self)
                if self.updates % self.report_every == 0:
                    self.report(losses)
                is_due = self.clock.seconds - self.saved_at >= self.save_every
                if is_due and self.check_numbers():
                    self.save()
            self.check_numbers()
        except NonFiniteError:
            raise
        except Exception:
            with contextlib.suppress(Exception):  # the first error is the one to tell
                self.save()
            raise
        finally:
            with contextlib.suppress(Exception):  # so it is here
                self.wait()
        self.save()

    def wait(self) -> None:
        """Waits until nothing acts in the environment, where the learner's collector acts ahead."""
        if hasattr(self.collect, "wait"):
            self.collect.wait()

    def update(self) -> dict[str, torch.Tensor]:
        """Learns from the rollout and counts it. Returns the learner's metrics."""
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
            self.opponents.refresh(self.policy, self.updates)
        if not self.clock.is_running:
            if torch.device(self.env.device).type == "cuda":
                torch.cuda.synchronize(self.env.device)
            self.clock.start()
            self.saved_at = self.clock.seconds
            self.reported_at = self.samples, self.clock.seconds
        return losses

    def report(self, losses: dict[str, torch.Tensor]) -> None:
        """Writes the metrics since the last report. Synchronises; raises what the environment
        flagged since then, if it has `check()`.
        """
        self.wait()
        if hasattr(self.env, "check"):
            self.env.check()
        values = torch.stack(list(losses.values())).tolist()
        episodes = self.episode_stats.take()
        if self.opponents is not None:
            episodes |= self.opponents.take()
        self.latest.update(episodes)
        found = {
            **episodes,
            **dict(zip(losses, values, strict=True)),
            "updates": self.updates,
            "lr": self.lr,
            "anneal": self.budget.anneal,
        }
        (samples, seconds), now = self.reported_at, self.clock.seconds
        self.reported_at = self.samples, now
        perf = {"perf/seconds": now}
        if self.samples > samples:  # the first update, which compiles, says nothing of the rate
            self.rate = (self.samples - samples) / (now - seconds)
            perf["perf/rate"] = self.rate
        self.metrics.write(self.samples, found, perf)
        self.score = found.get("episode/return", self.score)
        self.on_report(self)
        self.check_numbers()

    def check_numbers(self) -> bool:
        """Whether the last update was followed. Warns of the first number that could not be learnt
        from; NonFiniteError if none of the last `MAX_SKIPPED` rollouts could. Synchronises.
        """
        bad, n_skipped = self.learner.check.read(self.rollout.floats())
        if bad and self.rollout.learners is not None:
            lanes = self.rollout.learners.nonzero()[:, 0]
            bad = dataclasses.replace(bad, lane=int(lanes[bad.lane]))
        if bad and self.nonfinite_value is None:
            self.nonfinite_value = bad
            warnings.warn(f"{bad}; its rollout was not learnt from", stacklevel=2)
        if n_skipped < MAX_SKIPPED:
            return n_skipped == 0
        advice = f"the policy diverged, so try a learning rate smaller than {self.learner.lr:g}"
        if bad and bad.is_from_env:
            self.save()  # the policy is as good as it was before
            advice = f"the environment gave it, so look at how it computes {bad.name}"
        raise NonFiniteError(
            f"The last {n_skipped} updates were skipped, as their numbers were not finite or too "
            f"large ({bad or 'gradients'}): {advice}"
        )

    def save(self) -> None:
        """Writes a checkpoint, unless the last one holds the same."""
        self.saved_at = self.clock.seconds
        if not self.is_saved and self.save_checkpoint(self.samples, self.state_dict(), self.score):
            self.saved_updates = self.updates

    def state_dict(self) -> dict[str, Any]:
        """All that a run goes on from, as plain dicts of tensors and numbers."""
        others = {} if self.opponents is None else {"opponents": self.opponents.state_dict()}
        return dict(
            **others,
            policy=self.policy.state_dict(),
            learner=self.learner.state_dict(),
            episodes=self.episode_stats.state_dict(),
            samples=self.samples,
            updates=self.updates,
            seconds=self.clock.seconds,
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a `state_dict`. The environment starts new episodes."""
        self.policy.load_state_dict(state["policy"])
        self.learner.load_state_dict(state["learner"])
        self.episode_stats.load_state_dict(state["episodes"])
        if self.opponents is not None:
            self.opponents.load_state_dict(state["opponents"])
        self.samples, self.updates = state["samples"], state["updates"]
        self.clock.before = state["seconds"]
        self.saved_updates = self.updates
