"""Statistics of episodes, accumulated on the device, by when the episodes began.

Axes: T time, B lanes, K intervals between reports, C columns: all lanes, each group of lanes, each
source of layouts; S statistics of an episode.
"""

from __future__ import annotations

import math
import operator
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from megastep.agents.algorithms.cuda_graph import CudaGraphUpdate
from megastep.agents.algorithms.nonfinite import LIMIT
from megastep.agents.storage.rollout import Rollout
from megastep.devices import threads
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch
from megastep.types import Env, optional

if TYPE_CHECKING:
    from megastep.agents.training.trainer import Trainer
    from megastep.agents.types import StateDict

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
#: Means are over at least this many episodes, once so many have been counted.
MIN_EPISODES = 100
#: Intervals whose episodes are counted at a time. The last one grows while all others wait.
N_INTERVALS = 16
#: Steps of an episode after which no report waits for its end.
LONGEST = 10_000
_SAVED = "totals", "is_whole", "began", "sums"


class EpisodeStats:
    """Accumulates return, length and metrics of episodes. Only `pop` synchronises: it reports on
    episodes that *began* in an interval, once all have ended; of those that end in one, too many
    are short.

    Args:
        metrics: names of the metrics that worlds carry.
        groups: group name -> (B,) bool. Each group's means are reported beside the overall ones.
        sources: the name of the source of each layout, (D,), or None. The means of the episodes in
            each source's layouts are reported, too, unless a group has its name.
        skip_first: leaves out each lane's first episode, which `desync` cut.

    Attributes:
        totals: (2, B) float64, return and length so far of the episode that each lane is in.
        is_whole: (B,) bool, whether that episode is to be counted.
        began: (B,) int64, the interval in which it began.
        intervals: those whose episodes have not all ended, the oldest first. Numbers are reused.
        newest: () int64, the last of them.
        sums: (C, S, K) float64, over the episodes that began in an interval and have ended: count,
            return, squared return, length, each metric, and for each metric how many episodes were
            left out of it, and for how many of these it was not NaN.
        windows: for each column, the sums of the last reports with `MIN_EPISODES` together.
    """

    def __init__(
        self,
        n_lanes: int,
        device: torch.device | str,
        metrics: Sequence[str] = (),
        groups: Mapping[str, torch.Tensor] | None = None,
        skip_first: bool = False,
        sources: Sequence[str] | None = None,
    ):
        self.metrics, self.groups = tuple(metrics), tuple(groups or ())
        self.sources = tuple(dict.fromkeys(sources or ()))
        numbers = [self.sources.index(name) for name in sources or ()]
        self.source_of_layout = torch.tensor(numbers, dtype=torch.int32, device=device)
        all_lanes = torch.ones(n_lanes, dtype=torch.bool, device=device)
        self.members = torch.stack([all_lanes, *(groups or {}).values()]).double()
        self.totals = torch.zeros(2, n_lanes, dtype=torch.float64, device=device)
        self.is_whole = torch.full((n_lanes,), not skip_first, device=device)
        self.began = torch.zeros(n_lanes, dtype=torch.int64, device=device)
        self.intervals, self.newest = [0], torch.zeros((), dtype=torch.int64, device=device)
        self.numbers = torch.arange(N_INTERVALS, device=device)[:, None]
        shape = len(self.members) + len(self.sources), 4 + 3 * len(self.metrics), N_INTERVALS
        self.sums = torch.zeros(shape, dtype=torch.float64, device=device)
        self.windows = [deque() for _ in self.sums]
        self.infinite: list[str] = []

    def add(
        self,
        reward: torch.Tensor,
        reset: torch.Tensor,
        done: torch.Tensor,
        learns: torch.Tensor | bool = True,
        metrics: Mapping[str, torch.Tensor] | None = None,
        layouts: torch.Tensor | None = None,
    ) -> None:
        """Adds T transitions.

        Args:
            reward: (T, B). NaN, infinity and values beyond `nonfinite.LIMIT` count as 0.
            reset: (T, B) bool, true if the transition only started a new episode.
            done: (T, B) bool, true if the episode ended.
            learns: (T, B) bool. An episode counts if this was true when its last action was chosen.
            metrics: name -> (T, B), read where `done`. An episode whose metric is not finite or
                beyond the limit is left out of that metric's mean.
            layouts: (T, B) int32, the layout of each episode, read where `done`. For sources.
        """
        of_metrics = None
        if self.metrics:
            assert metrics is not None
            of_metrics = torch.stack([metrics[name].float() for name in self.metrics])
        if not isinstance(learns, torch.Tensor):
            learns = torch.full_like(done, learns)
        (n_steps, n_lanes), n_columns = reward.shape, 1 + len(self.sources)
        # over episodes that end here, of all lanes and each source: began before, or here
        sums = self.sums.new_zeros(n_columns, self.sums.shape[1], 2, n_lanes)
        has_begun = torch.empty_like(self.is_whole)
        launch(
            *(LIBRARY, "episodes", reward.device, n_lanes),
            reward=reward.float().contiguous(),
            reset=reset.contiguous(),
            done=done.contiguous(),
            learns=learns.contiguous(),
            metrics=of_metrics,
            layouts=None if layouts is None or not self.sources else layouts.contiguous(),
            source_of_layout=self.source_of_layout if self.sources else None,
            **dict(totals=self.totals, is_whole=self.is_whole, has_begun=has_begun, sums=sums),
            **dict(n_metrics=len(self.metrics), n_layouts=len(self.source_of_layout)),
            **dict(n_steps=n_steps, n_lanes=n_lanes, n_threads=threads(), limit=LIMIT),
        )
        began = torch.stack([self.began, self.newest.expand_as(self.began)])  # (2, B)
        is_in = (began == self.numbers[:, None]).double()  # (K, 2, B)
        columns = torch.cat([sums[0] * self.members[:, None, None], sums[1:]])  # (C, S, 2, B)
        self.sums += (columns[:, :, None] * is_in).sum((3, 4))
        # in place, as a CUDA graph wants it
        self.began.copy_(torch.where(has_begun, self.newest, self.began))

    def pop(
        self, sum_over_ranks: Callable[[torch.Tensor], torch.Tensor] = lambda sums: sums
    ) -> dict[str, float]:
        """Returns statistics for a report, and begins an interval. Synchronises.

        Means are over the episodes of intervals whose episodes have all ended since the last call,
        and if these are fewer than `MIN_EPISODES`, those of earlier calls, a call at a time.
        `sum_over_ranks` adds the numbers of the other ranks.

        Metrics:
            episode/count: episodes that no earlier report has counted.
            episode/window: episodes that the means are over.
            episode/return: mean return.
            episode/return_std: standard deviation of the return.
            episode/length: mean number of steps.
            episode/NAME: mean of a metric of the environment, over the episodes in which it is
                finite.
            episode/NAME/GROUP: the same, but for `return_std`, in the lanes of a role (leader) or
                of a kind of opponent (now, past, bot), or in the floor plans of a source (maze).
        """
        is_late = self.totals[1] > LONGEST
        self.began.copy_(torch.where(is_late, self.newest, self.began))
        n_running = ((self.began == self.numbers) & self.is_whole).sum(1)
        table = sum_over_ranks(torch.cat([self.sums.flatten(0, 1), n_running[None]])).cpu()
        sums, n_running = table[:-1].view(self.sums.shape), table[-1].tolist()
        complete = []
        while self.intervals and not n_running[self.intervals[0]]:
            complete.append(self.intervals.pop(0))
        reports = sums[:, :, complete].sum(2).tolist()
        self.sums[:, :, complete] = 0.0
        last = self.intervals[-1:]
        is_used = [n for n in last if n_running[n] or sums[0, 0, n]]
        if not last or (is_used and len(self.intervals) < N_INTERVALS):
            self.intervals.append(min({*range(N_INTERVALS)} - {*self.intervals}))
            self.newest.fill_(self.intervals[-1])
        totals = [
            _add_report(window, report)
            for window, report in zip(self.windows, reports, strict=True)
        ]
        n_infinite = reports[0][4 + 2 * len(self.metrics) :]
        self.infinite = [name for name, n in zip(self.metrics, n_infinite, strict=True) if n]
        stats = self._means(reports[0], totals[0])
        n, _, squared_returns, *_ = totals[0]
        if n:
            variance = squared_returns / n - stats["episode/return"] ** 2
            stats["episode/return_std"] = math.sqrt(max(variance, 0.0))
        names = *self.groups, *self.sources
        for group, report, total in zip(names, reports[1:], totals[1:], strict=True):
            by_name = {f"{name}/{group}": n for name, n in self._means(report, total).items()}
            stats |= {name: n for name, n in by_name.items() if name not in stats}
        return stats

    def _means(self, report, totals) -> dict[str, float]:
        """Returns counts and means by name from the sums of a report and those of a window."""
        n, returns, _, lengths, *metrics = totals
        stats: dict[str, float] = {"episode/count": int(report[0])}
        if n:
            stats |= {"episode/window": int(n), "episode/return": returns / n}
            stats["episode/length"] = lengths / n
            left_out = metrics[len(self.metrics) :]
            for name, total, n_left_out in zip(self.metrics, metrics, left_out):
                if n > n_left_out:
                    stats[f"episode/{name}"] = total / (n - n_left_out)
        return stats

    def state_dict(self) -> StateDict:
        """Returns a copy of everything that changes."""
        windows = [torch.tensor(window, dtype=torch.float64) for window in self.windows]
        state = {name: getattr(self, name).clone() for name in _SAVED}
        return state | dict(windows=windows, intervals=[*self.intervals])

    def load_state_dict(self, state: StateDict, has_episodes: bool = True) -> None:
        """Restores a `state_dict`, unless it has other metrics or groups; or just the reports."""
        if state["sums"].shape != self.sums.shape:
            return
        self.windows = [deque(window.tolist()) for window in state["windows"]]
        self.intervals = [*state["intervals"]]
        self.newest.fill_(self.intervals[-1])
        self.began.copy_(self.newest.expand_as(self.began))
        for name in _SAVED if has_episodes else ():
            getattr(self, name).copy_(state[name])


def lane_groups(env: Env, stored: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """Returns groups of (stored) lanes by name, (B,) bool: of each role and kind of opponent."""
    groups, roles = {}, optional(env, "roles") or ()
    for role in dict.fromkeys(roles):
        has_role = torch.tensor([name == role for name in roles], device=env.device)
        groups[role] = has_role.repeat(env.n_envs)
    groups |= optional(env, "matchups")
    return groups if stored is None else {name: lanes[stored] for name, lanes in groups.items()}


def _add_report(window, report) -> list[float]:
    """Adds a report's sums to a window, in place. Returns the sums over it."""
    if report[0]:
        window.append(report)
    counts = [report[0] for report in window]
    while counts and sum(counts) - counts[0] >= MIN_EPISODES:
        window.popleft()
        del counts[0]
    return [math.fsum(column) for column in zip(*window, strict=True)] or [0.0] * len(report)


class Episodes:
    """A callback that counts a trainer's episodes, for the curriculum and `opponents`, too."""

    def __init__(self, trainer: Trainer):
        self.opponents = optional(trainer.env, "opponent_pool")
        device = torch.device(trainer.env.device)
        self.graph = CudaGraphUpdate(self.count, device, graph=True)
        self.counted_tensors: list[torch.Tensor | None] = []
        self.warned: set[str] = set()
        self.begin(trainer)

    def begin(
        self, trainer: Trainer, sources: Sequence[str] | None = None, desync: bool = False
    ) -> None:
        """Begins to count, by the source of each layout; `desync` starts at random ages."""
        env, rollout = trainer.env, trainer.rollout
        allocate_layouts = getattr(trainer.collect, "allocate_layouts", None)
        if optional(env, "layout") is None or not allocate_layouts:
            sources = None
        elif sources:
            allocate_layouts()
        if desync := desync and optional(env, "desync") is not None:
            optional(env, "desync")()
        groups = lane_groups(env, rollout.learners)
        self.stats = EpisodeStats(
            rollout.n_lanes, env.device, tuple(rollout.metrics), groups, desync, sources
        )

    @property
    def names(self) -> list[str]:
        """The means over episodes that reports may have, without `episode/`."""
        of_all, parts = ["return", "length", *self.stats.metrics], self.stats.groups
        of_parts = [f"{name}/{x}" for x in (*parts, *self.stats.sources) for name in of_all]
        kinds = [] if self.opponents is None else [*self.opponents.matchups]
        return [*of_all, *of_parts, *(f"won/{kind}" for kind in kinds if kind != "now")]

    def on_update(self, trainer: Trainer, losses: object) -> None:
        """Counts episodes, and has curriculum and opponents learn from them."""
        rollout = trainer.rollout
        (self.graph if self._keeps_tensors(rollout) else self.count)(rollout)
        if trainer.curriculum is not None:
            trainer.curriculum.update(rollout)
        if self.opponents is not None:
            self.opponents.refresh_snapshots(trainer.policy, trainer.updates)

    def _keeps_tensors(self, rollout) -> bool:
        """Returns whether a rollout is where it was at first, as a CUDA graph wants it."""
        if type(rollout) is not Rollout:
            return False
        names = "reward", "starts", "terminal", "truncated", "learns", "layouts"
        tensors = [getattr(rollout, name) for name in names] + [*rollout.metrics.values()]
        self.counted_tensors = self.counted_tensors or tensors
        return all(map(operator.is_, tensors, self.counted_tensors))

    def count(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Counts the episodes of a rollout. Returns no metrics."""
        self.stats.add(
            rollout.reward,
            rollout.reset,
            rollout.terminal | rollout.truncated,
            rollout.learns[:-1],
            rollout.metrics,
            rollout.layouts if self.stats.sources else None,
        )
        return {}

    def on_measure(self, trainer: Trainer, metrics: dict[str, Any]) -> None:
        """Adds the statistics since the last report. Warns once of each infinite metric."""
        stats = self.stats.pop(trainer.ranks.sum)
        for name in self.stats.infinite:
            if name not in self.warned and trainer.ranks.rank == 0:
                warnings.warn(
                    f"metrics.{name} was infinite or beyond {LIMIT:g} at the end of an episode; "
                    f"such episodes are left out of episode/{name}",
                    stacklevel=3,
                )
            self.warned.add(name)
        if self.opponents is not None:
            stats |= self.opponents.pop_win_rates(trainer.ranks.sum)
        if trainer.curriculum is not None:
            stats |= trainer.ranks.mean(trainer.curriculum.stats())
        trainer.latest_stats |= stats
        metrics |= stats
        if stats.get("episode/window", 0) >= MIN_EPISODES:
            trainer.score = stats["episode/return"]
