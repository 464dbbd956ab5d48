"""Statistics of whole episodes, summed lane by lane on the device.

Axes: T time, B lanes, G groups of lanes.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from megastep.agents.algorithms.nonfinite import LIMIT


class EpisodeStats:
    """Return, length and metrics of the episodes that end, each summed from its first step; only
    `take` synchronises.

    Args: `metrics`, the names of those that worlds carry; `groups`, by name, which lanes (B,) bool
    have means of their own as well.
    """

    def __init__(
        self,
        n_lanes: int,
        device: torch.device | str,
        metrics: Sequence[str] = (),
        groups: Mapping[str, torch.Tensor] | None = None,
    ):
        self.metrics, self.groups = tuple(metrics), tuple(groups or ())
        every = torch.ones(n_lanes, dtype=torch.bool, device=device)
        self.members = torch.stack([every, *(groups or {}).values()], 1).double()  # (B, 1 + G)
        # of the episodes that go on, (B,)
        self.returns = torch.zeros(n_lanes, dtype=torch.float64, device=device)
        self.lengths = torch.zeros(n_lanes, dtype=torch.float64, device=device)
        # of those that ended, in all lanes and in each group: their number, sums of returns, of
        # squared returns, of lengths, of each metric
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
        """Takes T transitions of B lanes; `reward`, `reset`, `done` and `metrics` (T, B) are those
        of the worlds that followed. EpisodeStats count where `learns` (T, B), in the world before their
        end. A reward that is not finite, or beyond `finite.LIMIT`, counts as 0.
        """
        reward = torch.where(reward.abs() <= LIMIT, reward, 0.0)
        # cumulative sums over all T rows, less the sum at the last end before each row
        returns = self.returns + reward.double().cumsum(0)
        lengths = self.lengths + (~reset).double().cumsum(0)
        rows = torch.arange(len(reward), device=reward.device)[:, None]
        last = torch.where(done, rows, -1).cummax(0).values
        before = torch.cat([torch.full_like(last[:1], -1), last[:-1]])
        finished, ended = _since(returns, before), done & learns
        values = [
            torch.ones_like(finished),
            finished,
            finished**2,
            _since(lengths, before),
            *(metrics[name].double() for name in self.metrics),
        ]
        sums = torch.stack([torch.where(ended, each, 0.0).sum(0) for each in values])
        self.sums += sums @ self.members
        self.returns = _since(returns, last, slice(-1, None))[0]
        self.lengths = _since(lengths, last, slice(-1, None))[0]

    def take(self) -> dict[str, float]:
        """Of the episodes that ended since the last call: how many, mean and standard deviation of
        the return, means of length and metrics; means by group, too: `episode/return/leader`.
        """
        totals, *groups = self.sums.T.tolist()
        self.sums.zero_()
        n, _, squares, *_ = totals
        if not n:
            return {"episode/count": 0}
        means = self._means(totals)
        found = {
            "episode/count": int(n),
            **means,
            "episode/return_std": math.sqrt(max(squares / n - means["episode/return"] ** 2, 0.0)),
        }
        for group, own in zip(self.groups, groups, strict=True):
            found |= {f"{name}/{group}": mean for name, mean in self._means(own).items()}
        return found

    def _means(self, totals):
        n, total, _, steps, *metrics = totals
        if not n:
            return {}
        named = {"return": total, "length": steps, **dict(zip(self.metrics, metrics, strict=True))}
        return {f"episode/{name}": value / n for name, value in named.items()}

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The sums over episodes that ended. EpisodeStats that go on are not saved, as environments are
        not: a resumed run starts them anew.
        """
        return {"sums": self.sums}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Sums of other metrics, of an environment that has changed since, are left out."""
        if state["sums"].shape == self.sums.shape:
            self.sums.copy_(state["sums"])


def lane_groups(env: Any, chosen: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """Groups of an environment's lanes, by name, or of those `chosen`: its roles, several agents
    may share one, and the `kinds` of opponents that they meet.
    """
    groups, roles = {}, getattr(env, "roles", None) or ()
    for role in dict.fromkeys(roles):
        own = torch.tensor([name == role for name in roles], device=env.device)
        groups[role] = own.repeat(env.n_envs)
    groups |= getattr(env, "kinds", {})
    return groups if chosen is None else {name: own[chosen] for name, own in groups.items()}


def _since(totals, ends, rows=slice(None)):
    """The cumulative sums (T, B) in some rows, less those in the row `ends` (T, B) of the last end,
    -1 for none.
    """
    ends = ends[rows]
    return totals[rows] - torch.where(ends >= 0, totals.gather(0, ends.clamp(min=0)), 0.0)
