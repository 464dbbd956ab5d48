"""Statistics of whole episodes, summed lane by lane on the device.

Axes: T time, B lanes.
"""

import math

import torch

from agents.finite import LIMIT


class Episodes:
    """Return and length of the episodes that end, each summed from its first step; only `take`
    synchronises.
    """

    def __init__(self, n_lanes: int, device: torch.device | str):
        # of the episodes that go on, (B,)
        self.returns = torch.zeros(n_lanes, dtype=torch.float64, device=device)
        self.lengths = torch.zeros(n_lanes, dtype=torch.float64, device=device)
        # of those that ended: their number, sum of returns, sum of squared returns, sum of lengths
        self.sums = torch.zeros(4, dtype=torch.float64, device=device)

    def add(self, reward: torch.Tensor, reset: torch.Tensor, done: torch.Tensor) -> None:
        """Takes T transitions of B lanes; `reward`, `reset`, `done` (T, B) are those of the worlds
        that followed. A reward that is not finite, or beyond `finite.LIMIT`, counts as 0.
        """
        reward = torch.where(reward.abs() <= LIMIT, reward, 0.0)
        # cumulative sums over all T rows, less the sum at the last end before each row
        returns = self.returns + reward.double().cumsum(0)
        lengths = self.lengths + (~reset).double().cumsum(0)
        rows = torch.arange(len(reward), device=reward.device)[:, None]
        last = torch.where(done, rows, -1).cummax(0).values
        before = torch.cat([torch.full_like(last[:1], -1), last[:-1]])
        finished = _since(returns, before)
        self.sums += torch.stack(
            [
                done.double().sum(),
                (finished * done).sum(),
                (finished**2 * done).sum(),
                (_since(lengths, before) * done).sum(),
            ]
        )
        self.returns = _since(returns, last, slice(-1, None))[0]
        self.lengths = _since(lengths, last, slice(-1, None))[0]

    def take(self) -> dict[str, float]:
        """Of the episodes that ended since the last call: how many, mean and standard deviation of
        the return, mean length.
        """
        n, total, squares, steps = self.sums.tolist()
        self.sums.zero_()
        if not n:
            return {"episode/count": 0}
        mean = total / n
        return {
            "episode/count": int(n),
            "episode/return": mean,
            "episode/length": steps / n,
            "episode/return_std": math.sqrt(max(squares / n - mean**2, 0.0)),
        }

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The sums over episodes that ended. Episodes that go on are not saved, as environments are
        not: a resumed run starts them anew.
        """
        return {"sums": self.sums}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self.sums.copy_(state["sums"])


def _since(totals, ends, rows=slice(None)):
    """The cumulative sums (T, B) in some rows, less those in the row `ends` (T, B) of the last end,
    -1 for none.
    """
    ends = ends[rows]
    return totals[rows] - torch.where(ends >= 0, totals.gather(0, ends.clamp(min=0)), 0.0)
