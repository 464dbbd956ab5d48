"""Statistics of finished episodes, accumulated on the device.

Axes: T time, B lanes, G groups of lanes.
"""

import math
from collections.abc import Mapping, Sequence

import torch

from megastep.agents.algorithms.nonfinite import LIMIT
from megastep.types import Env, optional


class EpisodeStats:
    """Accumulates return, length and metrics of the episodes that end. Only `pop` synchronises.

    Args:
        n_lanes: B.
        device: where the transitions are.
        metrics: names of the metrics that worlds carry.
        groups: group name -> (B,) bool. Each group's means are reported beside the overall ones.

    Attributes:
        returns, lengths: (B,) float64, of the episode that each lane is in.
        sums: (4 + metrics, 1 + G) float64, over finished episodes: count, return, squared return,
            length, and each metric; for all lanes and for each group.
    """

    def __init__(
        self,
        n_lanes: int,
        device: torch.device | str,
        metrics: Sequence[str] = (),
        groups: Mapping[str, torch.Tensor] | None = None,
    ):
        self.metrics, self.groups = tuple(metrics), tuple(groups or ())
        all_lanes = torch.ones(n_lanes, dtype=torch.bool, device=device)
        self.members = torch.stack([all_lanes, *(groups or {}).values()], 1).double()  # (B, 1 + G)
        self.returns = torch.zeros(n_lanes, dtype=torch.float64, device=device)
        self.lengths = torch.zeros(n_lanes, dtype=torch.float64, device=device)
        shape = 4 + len(self.metrics), 1 + len(self.groups)
        self.sums = torch.zeros(shape, dtype=torch.float64, device=device)

    def add(
        self,
        reward: torch.Tensor,
        reset: torch.Tensor,
        done: torch.Tensor,
        learns: torch.Tensor | bool = True,
        metrics: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        """Adds T transitions of B lanes.

        Args:
            reward: (T, B). NaN, infinity and values beyond `nonfinite.LIMIT` count as 0.
            reset: (T, B) bool, true if the transition only started a new episode.
            done: (T, B) bool, true if the episode ended.
            learns: (T, B) bool. An episode counts if this was true when its last action was chosen.
            metrics: name -> (T, B), read where `done`.
        """
        reward = torch.where(reward.abs() <= LIMIT, reward, 0.0)
        # cumulative sums over all T rows, minus the sum at the last episode end before each row
        returns = self.returns + reward.double().cumsum(0)
        lengths = self.lengths + (~reset).double().cumsum(0)
        rows = torch.arange(len(reward), device=reward.device)[:, None]
        last_end = torch.where(done, rows, -1).cummax(0).values
        previous_end = torch.cat([torch.full_like(last_end[:1], -1), last_end[:-1]])
        episode_returns, counts = _sum_since(returns, previous_end), done & learns
        values = [
            torch.ones_like(episode_returns),
            episode_returns,
            episode_returns**2,
            _sum_since(lengths, previous_end),
            *(metrics[name].double() for name in self.metrics),
        ]
        sums = torch.stack([torch.where(counts, value, 0.0).sum(0) for value in values])
        self.sums += sums @ self.members
        self.returns = _sum_since(returns, last_end, slice(-1, None))[0]
        self.lengths = _sum_since(lengths, last_end, slice(-1, None))[0]

    def pop(self) -> dict[str, float]:
        """Returns statistics of the episodes that ended since the last call. Synchronises.

        Holds `episode/count`, the means of return, length and metrics, the standard deviation of
        the return, and each mean by group, such as `episode/return/leader`. Groups without a
        finished episode are absent; without any finished episode, `episode/count` is all.
        """
        totals, *group_totals = self.sums.T.tolist()
        self.sums.zero_()
        n, _, squared_returns, *_ = totals
        if not n:
            return {"episode/count": 0}
        means = self._means(totals)
        variance = squared_returns / n - means["episode/return"] ** 2
        stats = {
            "episode/count": int(n),
            **means,
            "episode/return_std": math.sqrt(max(variance, 0.0)),
        }
        for group, totals in zip(self.groups, group_totals, strict=True):
            stats |= {f"{name}/{group}": mean for name, mean in self._means(totals).items()}
        return stats

    def _means(self, totals):
        n, returns, _, lengths, *metrics = totals
        if not n:
            return {}
        by_metric = dict(zip(self.metrics, metrics, strict=True))
        by_name = {"return": returns, "length": lengths, **by_metric}
        return {f"episode/{name}": total / n for name, total in by_name.items()}

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Returns the sums over finished episodes.

        Unfinished episodes are not saved: a resumed run starts new episodes.
        """
        return {"sums": self.sums}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Restores a `state_dict`. Ignores one with other metrics or groups."""
        if state["sums"].shape == self.sums.shape:
            self.sums.copy_(state["sums"])


def lane_groups(env: Env, stored: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """Returns groups of an environment's lanes: one per role, and one per kind of opponent.

    Args:
        env: `env.roles` names the role of each agent slot; several slots may share a role.
            `env.matchups` is that of `selfplay.opponents.Opponents`. Both are optional.
        stored: (all lanes,) bool, the lanes to keep in each group, such as those that learn.

    Returns:
        Group name -> (B,) bool.
    """
    groups, roles = {}, optional(env, "roles") or ()
    for role in dict.fromkeys(roles):
        has_role = torch.tensor([name == role for name in roles], device=env.device)
        groups[role] = has_role.repeat(env.n_envs)
    groups |= optional(env, "matchups")
    return groups if stored is None else {name: lanes[stored] for name, lanes in groups.items()}


def _sum_since(cumulative, ends, rows=slice(None)):
    """Returns cumulative sums (T, B) at some rows, minus those at the row of the last episode end.

    Args:
        ends: (T, B) int64, the row of that end, -1 if there was none.
    """
    ends = ends[rows]
    at_end = torch.where(ends >= 0, cumulative.gather(0, ends.clamp(min=0)), 0.0)
    return cumulative[rows] - at_end
