"""The training loop: collect, update, log, save."""

from __future__ import annotations

import contextlib
import math
import operator
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import TYPE_CHECKING, cast

import torch

from megastep.agents.algorithms.cuda_graph import CudaGraphUpdate
from megastep.agents.algorithms.nonfinite import NonFiniteError, NonFiniteValue
from megastep.agents.distributed.agreement import Plan, agree
from megastep.agents.distributed.drift import check_drift
from megastep.agents.distributed.process_group import counts, unhurried, waiting
from megastep.agents.distributed.ranks import Ranks, world
from megastep.agents.errors import user_errors
from megastep.agents.runs.saver import NoSaver
from megastep.agents.storage.rollout import Rollout
from megastep.agents.training.budget import Budget, Stopwatch, evaluation_in, reaches
from megastep.agents.training.callbacks import Callbacks
from megastep.agents.training.closing import close_env
from megastep.agents.training.episode_stats import MIN_EPISODES, EpisodeStats, lane_groups
from megastep.agents.training.loggers import NoLogger
from megastep.agents.training.nonfinite_guard import NonFiniteGuard
from megastep.agents.training.performance import PHASES, PhaseTimer, device_memory
from megastep.agents.training.run_state import RunState
from megastep.agents.types import CollectorOptions, LearnerOptions, with_defaults
from megastep.types import Env, optional

if TYPE_CHECKING:
    from megastep.agents.networks.policy import Policy
    from megastep.agents.runs.annealing import AnnealingRecord
    from megastep.agents.training.curriculum import Curriculum
    from megastep.agents.training.profiler import Profiler
    from megastep.agents.types import Learner, RolloutLike, RunLogger, SaverLike, StateDict
    from megastep.coefficients import Coefficients


#: Updates that the host may be ahead of a GPU. The learning rate of an update follows the clock at
#: its launch, so a host far ahead would let it fall late, and not to 0. A GPU goes on for so many
#: updates when the host is held up.
MAX_AHEAD = 8


class Trainer:
    """Trains a policy in an environment until a budget is spent.

    With several ranks, each has a trainer, and all do the same updates: rank 0's clock decides.

    Args:
        env: the environment.
        policy: the policy that the learner trains.
        learner: such as `PPO`.
        logger: such as `loggers.Loggers`; None writes nothing.
        saver: such as `saver.Saver`; None saves nothing.
        budget: when the run ends and how its learning rate falls; None: when `stop()` says so.
        log_every: updates between two reports.
        checkpoint_seconds: seconds between two checkpoints. One that is due while the last is still
            being written comes after it; below a second, training waits for it. Infinity: whoever
            goes through `rounds` saves; only the last one is saved here.
        desync: starts the first episodes at random ages, so that not all lanes end theirs at the
            same time, if the environment has a method `desync()`. Statistics leave these episodes
            out.
        on_log: called with the trainer after each report, for example to show progress.
        evaluator: measures the policy for a report, which has the numbers as `eval/NAME`, means
            over the ranks. Whatever it plays in is not the environment of the training, and its
            time does not count.
        evaluate_every: (number, "samples" or "seconds"): which reports the evaluator is called for,
            the first after each so many. A checkpoint follows, whose score is the return that was
            measured; other checkpoints have none. None: all reports.
        stop: by name, what the evaluator must measure at least for the run to end.
        snapshot_saver: such as `snapshots.SnapshotSaver`: called with the trainer before the first
            update and after each.
        repeat_hint: returns how to meet the first NaN or infinity of the run again, as the rest of
            a sentence, see `NonFiniteGuard`; it gets the trainer, too.
        annealing_record: such as `annealing.AnnealingRecord`: gets the factor of the learning rate
            in each update, and is flushed before each report.
        make_curriculum: returns what draws the homes of new episodes, such as `curriculum.SFL`, for
            the environment, the learner and the rollout; None leaves that to the environment.
        layout_sources: the name of the source of each of the environment's layouts, whose episodes
            have statistics of their own; None for none.
        profiler: profiles some of the updates, if not None.
        callbacks: objects with methods of `callbacks.HOOKS`.
        leader: a trainer whose plans this one follows, so that both do the same updates: the member
            of a population that is asked first.
        timetable: (samples, settings) each, in order: settings by key, such as `learner.lr`, that
            are set after so many samples, see `set_settings`.
        ranks: those that train this policy together; None: all that there are.

    Attributes:
        samples, updates: environment steps of all lanes of all ranks, and updates, so far.
        clock: counts the seconds of training.
        lr: the current learning rate.
        score: the last mean return that was logged, or None before `MIN_EPISODES` have ended: that
            of few episodes is luck, and would mark the first checkpoint as the best.
        samples_per_second: speed between the last two reports, or None.
        latest_stats: name -> the last value of each episode statistic.
        reported_stats: name -> value, the episode statistics of the last report.
        evaluation: name -> the last value that the evaluator measured.
        lost: what could not be restored of a resumed run and begins anew, a clause each; if any,
            the run does not continue bit for bit.
        nonfinite_guard: has the first NaN or infinity of the run.
        samples_at_report: samples at the last report that is due every `log_every` updates. A
            resumed run has all reports up to it, and writes the later ones.

    Raises:
        ValueError: the budget anneals the learning rate of a learner without `set_lr`; the
            curriculum has no use for the environment or the learner; `timetable` has a setting that
            cannot change.
    """

    def __init__(
        self,
        env: Env,
        policy: Policy,
        learner: Learner,
        logger: RunLogger | None = None,
        saver: SaverLike | None = None,
        budget: Budget | None = None,
        *,
        log_every: int = 1,
        checkpoint_seconds: float = 30.0,
        desync: bool = False,
        on_log: Callable[[Trainer], None] = lambda trainer: None,
        evaluator: Callable[[Policy], Mapping[str, float]] = lambda policy: {},
        evaluate_every: tuple[float, str] | None = None,
        stop: Mapping[str, float] | None = None,
        snapshot_saver: Callable[[Trainer], None] = lambda trainer: None,
        repeat_hint: Callable[[Trainer, NonFiniteValue], str] = lambda trainer, value: "",
        annealing_record: AnnealingRecord | None = None,
        make_curriculum: Callable[[Env, Learner, RolloutLike], Curriculum] | None = None,
        layout_sources: Sequence[str] | None = None,
        profiler: Profiler | None = None,
        callbacks: Sequence[object] = (),
        leader: Trainer | None = None,
        timetable: Sequence[tuple[int, Mapping[str, float]]] = (),
        ranks: Ranks | None = None,
    ):
        self.ranks = world() if ranks is None else ranks
        self.env, self.policy, self.learner = env, policy, learner
        self.logger = NoLogger() if logger is None else logger
        self.saver = NoSaver() if saver is None else saver
        self.budget = budget = Budget() if budget is None else budget
        self.log_every, self.checkpoint_seconds = log_every, checkpoint_seconds
        self.on_log, self.evaluator, self.snapshot_saver = on_log, evaluator, snapshot_saver
        self.evaluate_every, self.stop = evaluate_every, dict(stop or {})
        self.evaluation: dict[str, float] = {}
        self.evaluated_at: int | None = None
        self.last_report = {"samples": 0.0, "seconds": 0.0}
        self.opponents = optional(env, "opponent_pool")
        self.annealing_record, self.profiler = annealing_record, profiler
        self.callbacks, self.is_stopped = Callbacks(callbacks), False
        self.leader, self.timetable = leader, [*timetable]
        self.latest_plan: Plan | None = None
        options = with_defaults(learner, LearnerOptions)
        self.set_lr, self.read_lr = options.set_lr, options.read_lr
        self.warmup, self.extra = options.warmup, options.extra
        self.coefficients = [*optional(env, "coefficients")]
        self.has_env_schedules = any(one.schedules for one in self.coefficients)
        self.learner_coefficients = options.coefficients
        if options.coefficients is not None:
            self.coefficients.append(options.coefficients)
        self.scheduled: dict[str, float] = {}
        for key in {key for _, values in timetable for key in values}:
            self._owner(key)  # raises if there is none
        if budget.anneal != "never" and not self.set_lr:
            raise ValueError(
                f"{type(learner).__name__} has no set_lr(lr), so its learning rate cannot fall "
                f"with {budget.anneal}: use learner.anneal=never, or add the method"
            )
        self.collect = learner.collector(env)
        self.collector_options = with_defaults(self.collect, CollectorOptions)
        self.rollout = self.collect.rollout
        self.curriculum = make_curriculum and make_curriculum(env, learner, self.rollout)
        allocate_layouts = self.collector_options.allocate_layouts
        if optional(env, "layout") is None or not allocate_layouts:
            layout_sources = None
        elif layout_sources:
            allocate_layouts()
        desync = desync and optional(env, "desync") is not None
        if desync:  # the collector has reset the environment, and has not stepped it yet
            optional(env, "desync")()
        self.episode_stats = EpisodeStats(
            self.rollout.n_lanes,
            env.device,
            tuple(self.rollout.metrics),
            lane_groups(env, self.rollout.learners),
            skip_first=desync,
            sources=layout_sources,
        )
        device = torch.device(env.device)
        self.count_episodes = CudaGraphUpdate(self._count_episodes, device, graph=True)
        self.counted_tensors: list[torch.Tensor | None] = []
        self.run_state = RunState(
            env, policy, learner, self.collect, self.episode_stats, self.curriculum
        )
        self.nonfinite_guard = NonFiniteGuard(
            env, learner, lambda value: repeat_hint(self, value), self.ranks
        )
        self.clock = Stopwatch() if leader is None else leader.clock
        self.timer = PhaseTimer(env.device, counts.finish_phase) if leader is None else None
        self.samples = self.updates = 0
        self.lr = learner.lr
        self.score = self.samples_per_second = None
        self.latest_stats, self.reported_stats = {}, {}
        self.samples_at_log = self.updates_at_log = self.samples_at_report = 0
        self.seconds_at_log = self.seconds_at_checkpoint = 0.0
        self.updates_at_checkpoint, self.lost = None, []

    @property
    def fraction_left(self) -> float:
        """The fraction of the budget that is left."""
        return self.budget.fraction_left(self.updates, self.samples, self.clock.seconds)

    @property
    def is_reached(self) -> bool:
        """Whether the last evaluation ends the run."""
        return reaches(self.evaluation, self.stop)

    @property
    def is_saved(self) -> bool:
        """True if the last checkpoint holds every update, once `saver.wait()` has returned."""
        return self.updates_at_checkpoint == self.updates and self.saver.error is None

    @property
    def stats_names(self) -> list[str]:
        """The means over episodes that reports may have, without `episode/`."""
        kinds = [] if self.opponents is None else [*self.opponents.matchups]
        return [*self.episode_stats.names, *(f"won/{kind}" for kind in kinds if kind != "now")]

    def train(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Trains until the budget is spent or `stop()` returns True, then saves a checkpoint.

        Raises:
            NonFiniteError: training diverged, or the environment returns only NaN or infinity. The
                last good checkpoint is kept.
            Exception: any other error, after a checkpoint was saved if there are no other ranks.
        """
        for _ in self.rounds(stop):
            pass

    def rounds(self, stop: Callable[[], bool] = lambda: False) -> Generator[None, None, None]:
        """Trains as `train` does, and yields after each update: before its report, if there is one
        every `log_every` updates, and when it is written.
        """
        try:
            self.snapshot_saver(self)
            self.callbacks("on_start", self)
            while (plan := self.plan(stop() or self.is_stopped)).goes_on:
                if plan.saves and self.nonfinite_guard.check(self.rollout):
                    self.save_checkpoint()
                self.start("collect")
                self.follow_schedules(1 - plan.lr_fraction)
                self.rollout = self.collect()
                self.callbacks("on_rollout", self, self.rollout)
                self.start("update")
                losses = self.update(plan.lr_fraction)
                self.callbacks("on_update", self, losses)
                with unhurried():
                    self.snapshot_saver(self)
                if self.updates % self.log_every == 0:
                    yield
                    self.samples_at_report = self.samples
                    self.log(losses)
                    is_sound = self.nonfinite_guard.check(self.rollout)
                    is_evaluated = self.evaluate_every and self.evaluated_at == self.samples
                    if is_sound and is_evaluated and self.checkpoint_seconds < math.inf:
                        self.save_checkpoint()
                yield
            state = self.state_dict()  # a resumed run repeats what this last report empties
            if self.updates > self.updates_at_log:
                self.log(losses)
            self.nonfinite_guard.check(self.rollout)
        except NonFiniteError as error:
            if error.is_from_env:  # the skipped updates left the policy unchanged
                self.save_what_was_learnt()
            raise
        except Exception:
            if self.ranks.n > 1:  # the others are elsewhere
                self.saver.give_up()
                raise
            with contextlib.suppress(Exception):  # the first error is the one to report
                self.save_what_was_learnt()
            raise
        finally:
            with contextlib.suppress(Exception):  # as above
                self.wait_for_collector()
            self.wait_for_files()
        self.save_checkpoint(state, is_last=True)
        self.wait_for_files()
        self.callbacks("on_end", self)

    def end(self) -> None:
        """Ends training after the current update, as for a callback; all ranks do if one does."""
        self.is_stopped = True

    def close(self) -> None:
        """Closes the environment, which is no reason to lose what was learnt, and the files of
        metrics, after training.
        """
        close_env(self.env)
        if self.annealing_record is not None:
            self.annealing_record.close()
        self.logger.close()

    def plan(self, is_stopped: bool) -> Plan:
        """Returns what all ranks do next. First waits until a GPU is at most `MAX_AHEAD` updates
        behind.

        Args:
            is_stopped: a signal stops this rank.
        """
        if self.leader is not None:
            assert self.leader.latest_plan is not None
            return self.leader.latest_plan
        assert self.timer is not None
        with waiting():
            self.timer.wait(MAX_AHEAD * len(PHASES))
        seconds = self.clock.seconds
        seconds_since = seconds - self.seconds_at_checkpoint
        plan = Plan(
            goes_on=self.fraction_left > 0 and not self.is_reached,
            saves=self.clock.is_running and seconds_since >= self.checkpoint_seconds,
            lr_fraction=self.budget.lr_fraction(self.updates, self.samples, seconds),
        )
        # a slow disk does not stop training, unless a checkpoint of each update is wanted
        is_behind = self.saver.is_writing and self.checkpoint_seconds >= 1
        self.latest_plan = agree(plan, is_stopped, is_behind)
        return self.latest_plan

    def start(self, phase: str) -> None:
        """Starts one of the `PHASES` of an update."""
        if self.profiler is not None:
            with unhurried():
                self.profiler.start(phase)
        if self.timer is not None:
            self.timer.start(phase)

    def wait_for_collector(self) -> None:
        """Waits until an async collector has stopped stepping the environment."""
        self.collector_options.wait()

    def update(self, lr_fraction: float = 1.0) -> dict[str, torch.Tensor]:
        """Learns from the current rollout. Returns the learner's metrics, tensors of shape ().

        Args:
            lr_fraction: factor of the learning rate.
        """
        rollout = cast("Rollout", self.rollout)
        if self.annealing_record is not None:
            self.annealing_record.append(lr_fraction)
        self._set_lr(lr_fraction)
        losses = self.learner.update(rollout)
        self.start("rest")
        keeps = self._keeps_tensors(rollout)
        (self.count_episodes if keeps else self._count_episodes)(rollout)
        if self.curriculum is not None:
            self.curriculum.update(rollout)
        self.samples += rollout.n_steps * rollout.n_lanes * self.ranks.n
        self.updates += 1
        if self.opponents is not None:
            self.opponents.refresh_snapshots(self.policy, self.updates)
        if not self.clock.is_running:
            self.start_clock()
        return losses

    def _keeps_tensors(self, rollout: Rollout) -> bool:
        """Returns whether a rollout is in the memory that it was in at the first update, as a CUDA
        graph wants it. A user's own rollout may replace its tensors, and so may a callback.
        """
        if type(rollout) is not Rollout:
            return False
        names = "reward", "starts", "terminal", "truncated", "learns", "layouts"
        tensors = [getattr(rollout, name) for name in names] + [*rollout.metrics.values()]
        self.counted_tensors = self.counted_tensors or tensors
        return all(map(operator.is_, tensors, self.counted_tensors))

    def _count_episodes(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        self.episode_stats.add(
            rollout.reward,
            rollout.reset,
            rollout.terminal | rollout.truncated,
            rollout.learns[:-1],
            rollout.metrics,
            rollout.layouts if self.episode_stats.sources else None,
        )
        return {}

    def start_clock(self) -> None:
        """Begins to count seconds, once everything is compiled. Synchronises."""
        if torch.device(self.env.device).type == "cuda":
            torch.cuda.synchronize(self.env.device)
        self.clock.start()
        self.seconds_at_checkpoint = self.clock.seconds
        self.samples_at_log, self.seconds_at_log = self.samples, self.clock.seconds
        if self.timer is not None:
            self.timer.pop()

    def follow_schedules(self, fraction: float) -> None:
        """Sets what has a schedule, of the learner and of the environment.

        Args:
            fraction: of the budget that is spent.

        Raises:
            UserError: a schedule of the user's fails.
        """
        while self.timetable and self.timetable[0][0] <= self.samples:
            self.set_settings(self.timetable.pop(0)[1])
        if self.has_env_schedules:
            self.wait_for_collector()  # which reads them
        for one in self.coefficients:
            if one.schedules:
                with user_errors("", (ValueError,)):
                    self.scheduled |= one.follow(fraction)

    def set_settings(self, values: Mapping[str, float]) -> None:
        """Changes settings from the next update on, without waiting for the device.

        Args:
            values: numbers by key: `learner.NAME`, or `env.NAME`, of those that may be schedules.

        Raises:
            ValueError: a setting cannot change while training.
        """
        self.wait_for_collector()
        for key, value in values.items():
            self._owner(key).set(**{key.partition(".")[2]: value})
            if key == "learner.lr":
                self.lr = self.learner.lr = value

    def _owner(self, key) -> Coefficients:
        """Returns what holds a setting that may change. Raises ValueError if nothing does."""
        part, _, name = key.partition(".")
        owners = [self.learner_coefficients] if part == "learner" else self.coefficients
        for one in owners:
            if one is not None and name in one.values:
                return one
        raise ValueError(
            f"{key} cannot change while training: the learner and the environment have no such "
            "number"
        )

    def _set_lr(self, lr_fraction) -> None:
        """Sets the learning rate of an update, if it changes and the learner does not do so."""
        is_annealed = self.budget.anneal != "never"
        if not self.set_lr or self.read_lr:
            return
        if is_annealed or self.warmup or "lr" in self.scheduled:
            lr = self.scheduled.get("lr", self.learner.lr) * (lr_fraction if is_annealed else 1)
            if self.updates < self.warmup:
                lr *= (self.updates + 1) / self.warmup
            self.lr = lr
            self.set_lr(lr)

    def log(self, losses: dict[str, torch.Tensor]) -> None:
        """Writes the metrics of all ranks since the last report. Synchronises.

        A loss that is NaN has no value, as no gradient step was taken; it is left out. Rates and
        times leave out the first update, which compiles.

        Metrics:
            samples: environment steps so far, over all lanes that learn.
            updates: updates so far.
            lr: learning rate.
            anneal: what the learning rate falls with.
            schedule/NAME: a setting of the learner or the environment that has a schedule.
            eval/NAME: what an evaluation in training measured: `return`, `length`, and each metric
                of the environment, means over episodes in unseen homes.
            perf/rate: samples per second since the last report.
            perf/seconds: seconds of training so far.
            perf/collect: seconds of collecting since the last report, on a GPU of the GPU; with
                `learner.lag`, as far as the learner waits for it.
            perf/update: seconds of updates, in the same way.
            perf/rest: seconds of everything else: statistics, logging, checkpoints, evaluations.
            perf/seconds_to_stop: seconds of training at which an evaluation reached `stop`.
            perf/memory_allocated: on a GPU, bytes of tensors.
            perf/memory_reserved: on a GPU, bytes that PyTorch has reserved.
            perf/memory_peak: on a GPU, the most bytes of tensors so far. Of a population, whose
                members share the GPU, the first alone has these three, and the times of phases.

        Raises the errors that `env.check()` does, and DriftError if the ranks' weights differ.
        """
        self.wait_for_collector()
        optional(self.env, "check")()
        if self.ranks.n > 1:
            check_drift(self.policy, self.extra)
        loss_values = [torch.as_tensor(loss, device=self.env.device) for loss in losses.values()]
        loss_values = torch.stack(loss_values).tolist() if losses else []
        loss_values = dict(zip(losses, loss_values, strict=True))
        self.nonfinite_guard.warn_of_metrics(self.episode_stats, self.rollout)
        stats = self.episode_stats.pop(self.ranks.sum)
        if self.opponents is not None:
            stats |= self.opponents.pop_win_rates(self.ranks.sum)
        of_curriculum = {} if self.curriculum is None else self.curriculum.stats()
        evaluation = {}
        if self.evaluate_every is None or self.ranks.any(self._evaluation_is_due()):
            with unhurried(), self.clock.paused():
                evaluation = self.evaluator(self.policy)
        evaluation = {f"eval/{name}": value for name, value in evaluation.items()}
        means = self.ranks.mean({**of_curriculum, **loss_values, **evaluation})
        if evaluation:
            self.evaluated_at = self.samples
            self.evaluation = {n[5:]: means[n] for n in evaluation if n in means}
        stats |= {name: means[name] for name in of_curriculum if name in means}
        if (n_restarts := optional(self.env, "pop_restarts")()) is not None:
            n_restarts = torch.tensor([n_restarts], device=self.env.device)
            stats["episode/restarts"] = int(self.ranks.sum(n_restarts))
        self.latest_stats.update(stats)
        self.reported_stats = stats
        if self.read_lr:
            self.lr = self.read_lr()
        schedules = (name for name in self.scheduled if name != "lr")
        metrics = {
            **stats,
            **means,
            **{f"schedule/{name}": self.scheduled[name] for name in schedules},
            "updates": self.updates,
            "lr": self.lr,
            "anneal": self.budget.anneal,
        }
        seconds = self.clock.seconds
        perf = {"perf/seconds": seconds}
        if evaluation and self.is_reached:
            perf["perf/seconds_to_stop"] = seconds
        self.last_report = {"samples": self.samples, "seconds": seconds}
        if self.samples > self.samples_at_log:  # not for the first update, which compiles
            n_samples = self.samples - self.samples_at_log
            self.samples_per_second = n_samples / (seconds - self.seconds_at_log)
            perf["perf/rate"] = self.samples_per_second
            phases = {} if self.timer is None else self.timer.pop()
            perf |= {f"perf/{phase}": seconds_of for phase, seconds_of in phases.items()}
        memory = {} if self.leader is not None else device_memory(self.env.device)
        perf |= {f"perf/memory_{name}": n for name, n in memory.items()}
        self.samples_at_log, self.seconds_at_log = self.samples, seconds
        self.updates_at_log = self.updates
        with unhurried():
            if self.annealing_record is not None:
                with contextlib.suppress(OSError):  # the next report tries again
                    self.annealing_record.flush()
            self.logger.write(self.samples, metrics, perf)
        if stats.get("episode/window", 0) >= MIN_EPISODES:
            self.score = stats["episode/return"]
        self.on_log(self)
        self.callbacks("on_report", self, {**metrics, **perf, "samples": self.samples})

    def _evaluation_is_due(self) -> bool:
        assert self.evaluate_every is not None
        every, unit = self.evaluate_every
        now = {"samples": self.samples, "seconds": self.clock.seconds}
        return now[unit] // every > self.last_report[unit] // every

    def save_checkpoint(self, state: StateDict | None = None, is_last: bool = False) -> None:
        """Begins to save a checkpoint, unless the last one holds every update. All ranks call it.

        Args:
            state: of `state_dict`; default: that of now.
            is_last: no other checkpoint follows.
        """
        self.seconds_at_checkpoint = self.clock.seconds
        if not self.ranks.any(not self.is_saved or (is_last and self.saver.lacks_replay)):
            return
        if self.ranks.rank == 0:
            self.run_state.warn_of_unreachable()
        state = self.state_dict() if state is None else state
        # a checkpoint must not reach further than what is on disk of the run's files
        if self.ranks.any(not self._sync_files()) and not is_last:
            return
        score = self.score
        if self.evaluate_every is not None:
            is_evaluated = self.evaluated_at == self.samples
            score = self.evaluation.get("return") if is_evaluated else None
        with unhurried():
            self.saver(self.samples, state, score, is_last)
        self.updates_at_checkpoint = self.updates
        self.callbacks("on_checkpoint", self)

    @unhurried()
    def wait_for_files(self) -> None:
        """Waits until the last checkpoint and a profile are written, or have failed."""
        if self.profiler is not None:
            self.profiler.finish()
        self.saver.wait()

    @unhurried()
    def _sync_files(self) -> bool:
        """Returns whether the files of metrics are on disk, where this rank writes them."""
        try:
            self.logger.sync()
            if self.annealing_record is not None:
                self.annealing_record.sync()
        except OSError:
            return False
        return True

    def save_what_was_learnt(self) -> None:
        """Begins to save a checkpoint from which a resumed run starts new episodes: after an error
        the environment may be the cause, or in the middle of a rollout.
        """
        self.save_checkpoint(self.state_dict(has_episodes=False), is_last=True)

    def state_dict(self, has_episodes: bool = True) -> StateDict:
        """Returns all that a resumed run needs, as dicts of tensors and plain values, most of which
        share their memory with what trains.

        Args:
            has_episodes: includes the environment, and what the policy remembers of it.
        """
        self.wait_for_collector()
        counts = dict(
            samples=self.samples,
            updates=self.updates,
            seconds=self.clock.seconds,
            samples_at_report=self.samples_at_report,
            **{f"eval/{name}": value for name, value in self.evaluation.items()},
        )
        return counts | self.run_state.state_dict(has_episodes)

    def load_state_dict(self, state: StateDict, is_new_rank: bool = False) -> None:
        """Restores a `state_dict`. `lost` names what cannot be restored.

        Args:
            is_new_rank: it is rank 0's, as this rank has none of its own.
        """
        self.samples, self.updates = state["samples"], state["updates"]
        self.clock.seconds_before = state["seconds"]
        self.samples_at_report = state["samples_at_report"]
        self.last_report = {"samples": self.samples_at_report, "seconds": state["seconds"]}
        self.evaluation = evaluation_in(state)
        self.updates_at_checkpoint = self.updates_at_log = self.updates
        self.lost = self.run_state.load_state_dict(state, is_new_rank)
