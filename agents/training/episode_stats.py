"""Statistics of finished episodes, accumulated on the device.

Axes: T time, B lanes, G groups of lanes, D layouts, S sources of layouts.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch

from megastep.agents.algorithms.nonfinite import LIMIT
from megastep.agents.types import StateDict
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch
from megastep.types import Env, optional

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels", FAST_CUDA_FLAGS)

#: Means are over at least this many episodes, once so many have ended.
MIN_EPISODES = 100
_SAVED = "returns", "lengths", "is_whole", "sums"


class EpisodeStats:
    """Accumulates return, length and metrics of the episodes that end. Only `pop` synchronises.

    Args:
        metrics: names of the metrics that worlds carry.
        groups: group name -> (B,) bool. Each group's means are reported beside the overall ones.
        sources: the name of the source of each layout, (D,), or None. The means of the episodes in
            each source's layouts are reported, too, unless a group has its name.
        skip_first: leaves out each lane's first episode, which `desync` cut.

    Attributes:
        returns, lengths: (B,) float64, of the episode that each lane is in.
        is_whole: (B,) bool, whether that episode is to be counted.
        sums: (4 + 2 M, 1 + G + S) float64 for M metrics, over the episodes that ended since the
            last `pop`: count, return, squared return, length, each metric, and for each metric the
            number of episodes left out of it; for all lanes, for each group and for each source.
        bad_lanes: (M,) int64, the first lane with a metric that was left out; `n_lanes` if none.
        windows: for all lanes, each group and each source, the sums of the last reports of all
            ranks, of which the others than the oldest hold fewer than `MIN_EPISODES`.
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
        self.source_of_layout = torch.tensor(
            [self.sources.index(name) for name in sources or ()], dtype=torch.int32, device=device
        )
        all_lanes = torch.ones(n_lanes, dtype=torch.bool, device=device)
        self.members = torch.stack([all_lanes, *(groups or {}).values()], 1).double()  # (B, 1 + G)
        self.returns = torch.zeros(n_lanes, dtype=torch.float64, device=device)
        self.lengths = torch.zeros(n_lanes, dtype=torch.float64, device=device)
        self.is_whole = torch.full((n_lanes,), not skip_first, device=device)
        n_columns = 1 + len(self.groups) + len(self.sources)
        shape = 4 + 2 * len(self.metrics), n_columns
        self.sums = torch.zeros(shape, dtype=torch.float64, device=device)
        self.bad_lanes = torch.full((len(self.metrics),), n_lanes, device=device)
        self.named = set()
        self.windows = [deque() for _ in range(n_columns)]

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
        if self._is_fused(reward, learns, metrics):
            self._add_on_gpu(reward, reset, done, learns, metrics, layouts)
            return
        reward = torch.where(reward.abs() <= LIMIT, reward, 0.0)
        # cumulative sums over all T rows, minus the sum at the last episode end before each row
        returns = self.returns + reward.double().cumsum(0)
        lengths = self.lengths + (~reset).double().cumsum(0)
        rows = torch.arange(len(reward), device=reward.device)[:, None]
        last_end = torch.where(done, rows, -1).cummax(0).values
        previous_end = torch.cat([torch.full_like(last_end[:1], -1), last_end[:-1]])
        episode_returns = _sum_since(returns, previous_end)
        counts = done & learns & (self.is_whole | (previous_end >= 0))
        values = [
            torch.ones_like(episode_returns),
            episode_returns,
            episode_returns**2,
            _sum_since(lengths, previous_end),
        ]
        by_source = None
        if self.sources:
            assert layouts is not None
            last = len(self.source_of_layout) - 1
            source_of_row = self.source_of_layout[layouts.clamp(0, last).long()]
            source_of_row = torch.where((layouts >= 0) & (layouts <= last), source_of_row, -1)
            rows = [counts & (source_of_row == source) for source in range(len(self.sources))]
            by_source = torch.stack([self._sum(one, values, metrics) for one in rows], 1)
        columns = self._sum(counts, values, metrics) @ self.members
        if by_source is not None:
            columns = torch.cat([columns, by_source.sum(2)], 1)
        self.sums += columns
        # in place, as a CUDA graph wants it
        self.returns.copy_(_sum_since(returns, last_end, slice(-1, None))[0])
        self.lengths.copy_(_sum_since(lengths, last_end, slice(-1, None))[0])
        self.is_whole |= done.any(0)

    def _is_fused(self, reward, learns, metrics) -> bool:
        values = [metrics[name] for name in self.metrics]
        return (
            reward.is_cuda
            and isinstance(learns, torch.Tensor)
            and len(values) <= LIBRARY.constants["EPISODE_METRICS"]
            and all(value.dtype == torch.float32 for value in (reward, *values))
        )

    def _add_on_gpu(self, reward, reset, done, learns, metrics, layouts) -> None:
        """Does the same as `add` in two kernels."""
        n_steps, n_lanes = reward.shape
        values = [metrics[name].contiguous() for name in self.metrics]
        pack = LIBRARY.params.EpisodeMetricParams
        of_lanes = self.sums.new_empty(len(self.sums), n_lanes)
        source_sums = None
        if self.sources:
            source_sums = self.sums.new_empty(len(self.sums), len(self.sources), n_lanes)
            layouts = layouts.contiguous()
        launch(
            *(LIBRARY, "episodes", reward.device, n_lanes),
            metrics=b"".join(pack(values=value) for value in values),
            reward=reward.contiguous(),
            reset=reset.contiguous(),
            done=done.contiguous(),
            learns=learns.contiguous(),
            layouts=layouts if self.sources else None,
            source_of_layout=self.source_of_layout if self.sources else None,
            returns=self.returns,
            lengths=self.lengths,
            is_whole=self.is_whole,
            sums=of_lanes,
            source_sums=source_sums,
            bad_lanes=self.bad_lanes,
            n_metrics=len(values),
            n_sources=len(self.sources),
            n_layouts=len(self.source_of_layout),
            n_steps=n_steps,
            n_lanes=n_lanes,
            limit=LIMIT,
        )
        n_sums, n_columns = self.sums.shape
        blocks = Blocks(n_columns, n_sums, LIBRARY.constants["COLUMNS_THREADS"])
        launch(
            *(LIBRARY, "episode_columns", reward.device, blocks),
            of_lanes=of_lanes,
            members=self.members,
            source_sums=source_sums,
            sums=self.sums,
            n_groups=self.members.shape[1],
            n_lanes=n_lanes,
        )

    def _sum(self, counts, values, metrics) -> torch.Tensor:
        """Returns the sums over time of the episodes that count, (4 + 2 M, B)."""
        sums = torch.stack([torch.where(counts, value, 0.0).sum(0) for value in values])
        if not self.metrics:
            return sums
        of_metrics = torch.stack([metrics[name] for name in self.metrics])  # (M, T, B)
        is_good = of_metrics.abs() <= LIMIT
        n_left_out = (counts & ~is_good).sum(1, dtype=torch.float64)
        lanes = torch.arange(counts.shape[1], device=counts.device)
        bad_lanes = torch.where(n_left_out > 0, lanes, counts.shape[1]).amin(1)
        torch.minimum(self.bad_lanes, bad_lanes, out=self.bad_lanes)
        totals = torch.where(counts & is_good, of_metrics, 0.0).sum(1, dtype=torch.float64)
        return torch.cat([sums, totals, n_left_out])

    def pop_bad_metrics(self) -> dict[str, int]:
        """Returns metrics that an episode was left out of, each once, with the first such lane.
        Synchronises.
        """
        lanes = dict(zip(self.metrics, self.bad_lanes.tolist(), strict=True))
        n_lanes = len(self.returns)
        bad = {k: lane for k, lane in lanes.items() if lane < n_lanes and k not in self.named}
        self.named |= bad.keys()
        return bad

    def pop(
        self, sum_over_ranks: Callable[[torch.Tensor], torch.Tensor] = lambda sums: sums
    ) -> dict[str, float]:
        """Returns statistics for a report. Synchronises.

        Args:
            sum_over_ranks: adds the numbers of the other ranks, where there are any.

        Means are over the episodes that ended since the last call and, if those are fewer than
        `MIN_EPISODES`, those of earlier calls, a call at a time. They are absent if there are none.

        Metrics:
            episode/count: episodes that ended since the last report.
            episode/window: episodes that the means are over.
            episode/return: mean return.
            episode/return_std: standard deviation of the return.
            episode/length: mean number of steps.
            episode/NAME: mean of a metric of the environment, over the episodes in which it is
                finite.
            episode/NAME/GROUP: the same, but for `return_std`, in the lanes of a role (leader) or
                of a kind of opponent (now, past, bot), or in the floor plans of a source (maze).
        """
        reports = sum_over_ranks(self.sums.T).tolist()
        self.sums.zero_()
        totals = [
            _add_report(window, report)
            for window, report in zip(self.windows, reports, strict=True)
        ]
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

    @property
    def names(self) -> list[str]:
        """The means that `pop` may return, without `episode/`."""
        of_all = ["return", "length", *self.metrics]
        parts = *self.groups, *self.sources
        return [*of_all, *(f"{name}/{part}" for part in parts for name in of_all)]

    def _means(self, report, totals) -> dict[str, float]:
        """Returns counts and means by name from the sums of a report and those of a window."""
        n, returns, _, lengths, *metrics = totals
        stats: dict[str, float] = {"episode/count": int(report[0])}
        if n:
            stats |= {"episode/window": int(n), "episode/return": returns / n}
            stats["episode/length"] = lengths / n
            n_metrics = len(self.metrics)
            pairs = zip(self.metrics, metrics[:n_metrics], metrics[n_metrics:], strict=True)
            for name, total, n_left_out in pairs:
                if n > n_left_out:
                    stats[f"episode/{name}"] = total / (n - n_left_out)
        return stats

    def state_dict(self) -> StateDict:
        """Returns a copy of everything that changes."""
        windows = [torch.tensor(window, dtype=torch.float64) for window in self.windows]
        return {name: getattr(self, name).clone() for name in _SAVED} | {"windows": windows}

    def load_state_dict(self, state: StateDict) -> None:
        """Restores a `state_dict`, unless it has other metrics or groups."""
        if state["sums"].shape != self.sums.shape:
            return
        for name in _SAVED:
            if name in state:
                getattr(self, name).copy_(state[name])
        self.windows = [deque(window.tolist()) for window in state["windows"]]


def lane_groups(env: Env, stored: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """Returns groups of an environment's lanes by name, (B,) bool: one per role, and one per kind
    of opponent.

    Args:
        env: may have `roles`, of each agent slot, and `matchups`, of `selfplay.opponents`.
        stored: (all lanes,) bool, the lanes to keep in each group, such as those that learn.
    """
    groups, roles = {}, optional(env, "roles") or ()
    for role in dict.fromkeys(roles):
        has_role = torch.tensor([name == role for name in roles], device=env.device)
        groups[role] = has_role.repeat(env.n_envs)
    groups |= optional(env, "matchups")
    return groups if stored is None else {name: lanes[stored] for name, lanes in groups.items()}


def _sum_since(cumulative, ends, rows=slice(None)) -> torch.Tensor:
    """Returns cumulative sums (T, B) at some rows, minus those at the row where the last episode
    ended, -1 if none did.
    """
    ends = ends[rows]
    at_end = torch.where(ends >= 0, cumulative.gather(0, ends.clamp(min=0)), 0.0)
    return cumulative[rows] - at_end


def _add_report(window, report) -> list[float]:
    """Adds a report's sums to a window, in place. Returns the sums over it."""
    if report[0]:
        window.append(report)
    counts = [report[0] for report in window]
    while counts and sum(counts) - counts[0] >= MIN_EPISODES:
        window.popleft()
        del counts[0]
    return [math.fsum(column) for column in zip(*window, strict=True)] or [0.0] * len(report)
