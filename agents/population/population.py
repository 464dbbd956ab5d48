"""The members of a population: they train in turns, on a GPU on a stream each, and take over from
each other every so many samples.

With several ranks, each trains every R-th member as a single process would, and all decide the same
from the scores of all. Only rank 0's clock counts.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import torch
from torch.utils._pytree import tree_map_only

from megastep import global_generators
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.distributed.process_group import (
    exchange,
    from_rank,
    from_rank_0,
    gather_objects,
    n_ranks,
    rank,
)
from megastep.agents.distributed.ranks import world
from megastep.agents.population import decisions
from megastep.agents.runs import json_lines, populations
from megastep.agents.training.episode_stats import MIN_EPISODES
from megastep.types import optional

if TYPE_CHECKING:
    from megastep.agents.factory.settings import Population as PopulationSettings
    from megastep.agents.networks.policy import Policy
    from megastep.agents.training.trainer import Trainer
    from megastep.agents.types import Learner, Row, StateDict

T = TypeVar("T")

#: Updates of each member that compile kernels and, on a GPU, record graphs: of all members together
#: these take much longer than of one.
N_PREPARING = {"cpu": 1, "cuda": 3}


class AgentParts(NamedTuple):
    """What a member has learnt: policy, learner, and wrappers of its environment."""

    policy: Policy
    learner: Learner
    wrappers: StateDict | None = None


def hosted(size: int) -> range:
    """Returns the numbers of the members that this rank trains: every R-th."""
    return range(rank(), size, n_ranks())


class Streams:
    """What each member of a process has for itself: a GPU's stream, and global generators."""

    def __init__(self, n: int, device: torch.device):
        self.device, is_on_gpu = device, device.type == "cuda"
        self.streams = [torch.cuda.Stream(device) for _ in range(n)] if is_on_gpu else None
        current = global_generators.Held.current()
        self.of_host = [current.copied() for _ in range(n)]
        self.gpu_generator, self.of_gpu = None, []
        if is_on_gpu:
            torch.cuda.init()
            index = torch.cuda.current_device() if device.index is None else device.index
            self.gpu_generator = torch.cuda.default_generators[index]
            self.of_gpu = [self.gpu_generator.get_state()] * n

    @contextlib.contextmanager
    def of(self, member: int) -> Iterator[None]:
        """What is done inside is this member's."""
        outside, stream = global_generators.Held.current(), contextlib.nullcontext()
        if self.streams is not None:
            stream = torch.cuda.stream(self.streams[member])
        try:
            with stream:
                self.of_host[member].install()
                if self.gpu_generator is not None:
                    self.gpu_generator.set_state(self.of_gpu[member])
                yield
                self.of_host[member] = global_generators.Held.current()
                if self.gpu_generator is not None:
                    self.of_gpu[member] = self.gpu_generator.get_state()
        finally:
            outside.install()

    def each(self, call: Callable[[int], T]) -> list[T]:
        """Calls a function of each member in turn, inside `of`. Returns the results."""
        results = []
        for member in range(len(self.of_host)):
            with self.of(member):
                results.append(call(member))
        return results

    def wait(self) -> None:
        """Waits until all members have done what is launched."""
        if self.streams is not None:
            torch.cuda.synchronize(self.device)


class Population:
    """Trains members and lets them take over from each other.

    A member that diverges goes on without learning, and copies another at the next generation.

    Args:
        trainers: of the members that this rank hosts, made in `streams`. The first plans for all.
        folder: where `population.jsonl` is written.
        chosen: its settings. A generation is at the first report after `every` samples, and none
            when the budget is spent.
        visitor: with several ranks, holds what a member of another one has learnt.
        repeated: the samples after which the generations are, if another population is repeated.

    Attributes:
        members: numbers of the members that this rank hosts.
        settings: of each member, by key.
    """

    def __init__(
        self,
        trainers: Sequence[Trainer],
        streams: Streams,
        folder: Path,
        seed: int,
        chosen: PopulationSettings,
        checkpoint_seconds: float = 30.0,
        visitor: AgentParts | None = None,
        repeated: Collection[int] | None = None,
    ):
        self.trainers, self.streams, self.seed = [*trainers], streams, seed
        self.leader = self.trainers[0]  # the clock of rank 0's decides
        self.chosen, self.size, self.visitor = chosen, chosen.size, visitor
        self.members, self.n_ranks, self.repeated = hosted(chosen.size), n_ranks(), repeated
        self.checkpoint_seconds, self.saved_at = checkpoint_seconds, time.monotonic()
        self.path = folder / populations.FILE
        generations = from_rank_0(self._earlier)
        self.lines = json_lines.JsonLines(self.path) if rank() == 0 else None
        self.generation = max(0, len(generations) - 1)
        self.n_diverged = [0] * self.size
        self.samples_at_round = self.leader.samples_at_report
        for trainer in trainers:
            trainer.nonfinite_guard.tolerates_divergence = True
        for trainer in self.trainers[1:]:
            trainer.clock, trainer.timing.times_phases = self.leader.clock, False
        if generations:
            self.settings = [populations.settings_of(row) for row in generations[-1]]
            for rows in generations:
                for member, row in enumerate(rows):
                    self.n_diverged[member] += int(row.get("diverged", 0))
            self.streams.each(lambda i: self.trainers[i].tuning.set(self.settings[self.members[i]]))
        else:
            numbers = range(self.size)
            self.settings = [decisions.first(seed, member, chosen.vary) for member in numbers]
            self._write([None for _ in numbers], [*numbers])

    def _earlier(self) -> list[list[Row]]:
        """Returns the generations so far, and removes those after the checkpoints."""
        json_lines.truncate_after(self.path, self.samples or -1)
        return populations.read(self.path) if self.path.exists() else []

    @property
    def samples(self) -> int:
        """Samples of each member so far."""
        return self.leader.samples

    def train(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Trains until the budget is spent or a member ends, then saves. NonFiniteError."""

        def ends() -> bool:
            return stop() or any(one.is_stopped for one in self.trainers)

        trainers, each, n_rounds = self.trainers, self.streams.each, 0
        try:
            each(lambda i: trainers[i].callbacks("on_start", trainers[i]))
            while (plan := self.leader.plan(ends(), world())).goes_on:
                # all updates are launched before the first report waits for its own
                each(lambda i: trainers[i].update(plan.lr_fraction))
                if self.leader.updates % self.leader.log_every == 0:
                    each(lambda i: trainers[i].report())
                n_rounds += 1
                # seconds count from the last of these on
                if n_rounds <= N_PREPARING[self.streams.device.type]:
                    each(lambda i: trainers[i].start_clock())
                    self.saved_at = time.monotonic()
                self._after_round()
            from_rank_0(self._are_written)
            each(lambda i: trainers[i].finish())
        finally:
            for one in trainers:
                one.saver.wait()
            if self.lines is not None:
                self.lines.close()

    def _after_round(self) -> None:
        leader, before, is_due = self.leader, self.samples_at_round, False
        if leader.samples_at_report == leader.samples:
            self.samples_at_round = self.samples
            is_due = self.samples // self.chosen.every > before // self.chosen.every
        is_left = leader.fraction_left > 0
        if self.repeated is not None:  # when a budget was spent, the clock may have decided
            is_due, is_left = self.samples in self.repeated, True
        seconds = time.monotonic() - self.saved_at
        goes_on, is_time = exchange([is_left, seconds >= self.checkpoint_seconds])[0]
        if is_due and goes_on:
            self.take_over()
        self.meet()
        if is_time and from_rank_0(self._are_written):
            self.save()

    def meet(self) -> None:
        """Gives the members' opponents each other's policies, where they play in a league."""
        updates, pool = self.leader.updates, self.leader.episodes.opponents
        if pool is None or not pool.is_due(updates):
            return
        self.streams.wait()
        for member in range(self.size):
            learnt = self._of(pool.next_rival(member, self.size, updates), member)
            if learnt is not None:
                own = self._trainer(member).episodes.opponents
                assert own is not None
                own.refresh_rival(learnt.policy, updates)
        self.streams.wait()

    def save(self) -> None:
        """Begins to save a checkpoint of each member, once all have the last one."""
        for trainer in self.trainers:
            trainer.saver.wait()
        self.streams.each(lambda i: self.trainers[i].save())
        self.saved_at = time.monotonic()

    def take_over(self) -> None:
        """Lets members copy others, as `decisions.decide` says, and writes who did."""
        scores = self.gathered([self.score_of(trainer) for trainer in self.trainers])
        if all(score == -math.inf for score in scores):
            raise NonFiniteError(
                f"All {len(scores)} members diverged: choose a smaller range of learning rates",
                False,
            )
        self.generation += 1
        made = decisions.decide(self.seed, self.generation, scores, self.settings, self.chosen.vary)
        self.streams.wait()
        for member in decisions.order(made, scores):
            self.copy(made[member].source, member)
            if member in self.members:
                self._trainer(member).tuning.set(made[member].settings)
        self.streams.wait()
        self.settings = [one.settings for one in made]
        self._write(scores, [one.source for one in made])

    def score_of(self, trainer: Trainer) -> float | None:
        """Returns a member's score: minus infinity if it has diverged, None if it is unknown."""
        metrics, name = trainer.metrics, self.chosen.score
        if trainer.nonfinite_guard.has_diverged:
            return -math.inf
        if name == populations.EVALUATED:
            return trainer.evaluation.get("return")
        if metrics.get("episode/window", 0) < MIN_EPISODES:
            return None
        return metrics.get(f"episode/{'return' if name == populations.RUNNING else name}")

    def gathered(self, values: Sequence[T]) -> list[T]:
        """Returns a value of each member, from those of the members that this rank hosts."""
        by_rank = gather_objects([*values])
        return [by_rank[n % self.n_ranks][n // self.n_ranks] for n in range(self.size)]

    def copy(self, source: int, target: int) -> None:
        """Gives a member what another has learnt, in place: weights, optimizer, statistics."""
        learnt = self._of(source, target)
        if learnt is None:
            return
        trainer = self._trainer(target)
        copy_from = trainer.learner_options.copy_from
        assert copy_from is not None  # as `make_trainer` asks
        copy_from(learnt.learner)
        if learnt.wrappers:
            optional(trainer.env, "load_wrapper_state")(learnt.wrappers, False)
        trainer.nonfinite_guard.has_diverged = False

    def _trainer(self, member: int) -> Trainer:
        return self.trainers[self.members.index(member)]

    def _of(self, source: int, target: int) -> AgentParts | None:
        """Returns what a member has learnt where another is hosted. All ranks call it."""
        learnt = state = None
        if source in self.members:
            trainer = self._trainer(source)
            wrappers = optional(trainer.env, "wrapper_state")()
            learnt = AgentParts(trainer.policy, trainer.learner, wrappers)
        if source % self.n_ranks == target % self.n_ranks:
            return learnt
        if learnt is not None:
            parts = learnt.policy.state_dict(), learnt.learner.state_dict(), learnt.wrappers
            state = tree_map_only(torch.Tensor, lambda x: x.detach().to("cpu", copy=True), parts)
        state = from_rank(source % self.n_ranks, state)
        if target not in self.members:
            return None
        assert state is not None and self.visitor is not None
        policy, learner, wrappers = state
        self.visitor.policy.load_state_dict(policy)
        self.visitor.learner.load_state_dict(learner)
        return self.visitor._replace(wrappers=wrappers)

    def _write(self, scores: Sequence[float | None], sources: Sequence[int]) -> None:
        for member, (score, source) in enumerate(zip(scores, sources, strict=True)):
            has_diverged = score == -math.inf
            self.n_diverged[member] += has_diverged
            row: dict[str, float | str] = {"generation": self.generation, "member": member}
            row["from"] = source
            if score is not None and not has_diverged:
                row["score"] = score
            if has_diverged:
                row["diverged"] = 1
            of_settings = self.settings[member].items()
            row |= {f"{populations.KEY}{key}": value for key, value in of_settings}
            if self.lines is not None:
                self.lines.write(self.samples, row)

    def _are_written(self) -> bool:
        """Flushes the generations to disk. Returns whether they are there."""
        return self.lines is None or self.lines.sync()

    def close(self) -> None:
        """Closes the members' environments and files."""
        for trainer in self.trainers:
            trainer.close()
