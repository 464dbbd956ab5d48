"""The share of an evaluation's environments that each rank plays.

Of N environments in D homes, environment e plays in home e mod D. Rank r of R plays environments
r, r + R, r + 2 R, ... So all ranks together play in the homes that one process plays in, in each
as often; spawns and sampled actions are others.
"""

from typing import TypeVar

import torch

from megastep.agents.distributed.process_group import gather_objects, n_ranks, rank
from megastep.arrdict import arrdict

Values = TypeVar("Values", torch.Tensor, arrdict)


class Shard:
    """One rank's share.

    Args:
        n_envs: N.
        n_homes: D, at most N; 0 if there are no homes.
        number, n_ranks: r and R, at most N.

    Attributes:
        envs: numbers of this rank's environments.
        homes: numbers of the homes that it plays in: environment i of it in home i mod their
            number.
    """

    def __init__(self, n_envs: int, n_homes: int, number: int = 0, n_ranks: int = 1):
        self.n_envs, self.n_ranks = n_envs, n_ranks
        self.envs = range(number, n_envs, n_ranks)
        self.homes = [*dict.fromkeys(env % n_homes for env in self.envs)] if n_homes else []

    @classmethod
    def of_this_rank(cls, n_envs: int, n_homes: int) -> "Shard":
        """Returns this rank's share: all of them, if there are fewer environments than ranks."""
        is_shared = n_ranks() <= n_envs
        return cls(n_envs, n_homes, rank(), n_ranks()) if is_shared else cls(n_envs, n_homes)

    def with_others(self, values: arrdict) -> arrdict:
        """Returns the values of all environments, in their order. Waits for the other ranks.

        Args:
            values: tensors of this rank's environments, or of their lanes: (n, ...) or (n A, ...).
                `envs` and `homes` hold numbers among those of this rank.
        """
        if self.n_ranks == 1:
            return values
        values = values.map(torch.Tensor.cpu)
        for name in ("envs", "homes"):
            if name in values and (numbers := [*getattr(self, name)]):
                values[name] = torch.tensor(numbers)[values[name].long()].to(values[name])
        return self._interleaved(gather_objects(values))

    def _interleaved(self, values: list[Values]) -> Values:
        if not isinstance(values[0], torch.Tensor):
            names = values[0].keys()
            return arrdict({n: self._interleaved([part[n] for part in values]) for n in names})
        n_each = len(values[0]) // len(range(0, self.n_envs, self.n_ranks))  # lanes of each
        rows = values[0].new_empty(self.n_envs, n_each, *values[0].shape[1:])
        for number, part in enumerate(values):
            rows[number :: self.n_ranks] = part.view(-1, *rows.shape[1:])
        return rows.flatten(0, 1)
