"""Shards of an evaluation: the environments that each rank plays.

Of N environments in D homes, environment e is in home e mod D. Rank r of R plays environments r,
r + R, r + 2 R, ... Together the ranks play each home as often as a single process does, but with
other spawns and sampled actions.
"""

from typing import TypeVar

import torch

from megastep.agents.distributed.process_group import gather_objects, n_ranks, rank
from megastep.arrdict import arrdict

Values = TypeVar("Values", torch.Tensor, arrdict)


class Shard:
    """The environments of rank `number` of `n_ranks`, at most N, among `n_envs` in `n_homes`.

    Attributes:
        envs: indices of its environments among the N.
        homes: indices of its homes among the D; its i-th environment is in `homes[i % len(homes)]`.
    """

    def __init__(self, n_envs: int, n_homes: int, number: int = 0, n_ranks: int = 1):
        self.n_envs, self.n_ranks = n_envs, n_ranks
        self.envs = range(number, n_envs, n_ranks)
        self.homes = [*dict.fromkeys(env % n_homes for env in self.envs)] if n_homes else []

    @classmethod
    def of_this_rank(cls, n_envs: int, n_homes: int) -> "Shard":
        """Returns this rank's shard; all N environments if there are fewer than ranks."""
        is_shared = n_ranks() <= n_envs
        return cls(n_envs, n_homes, rank(), n_ranks()) if is_shared else cls(n_envs, n_homes)

    def with_others(self, values: arrdict) -> arrdict:
        """Gathers the values of all N environments, in order, from tensors (n, ...) of this rank's
        n, or (n A, ...) of their lanes. Indices within the shard, in leaves called `envs` and
        `homes`, become indices among all. Waits for the other ranks.
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
        n_each = len(values[0]) // len(range(0, self.n_envs, self.n_ranks))  # lanes per environment
        rows = values[0].new_empty(self.n_envs, n_each, *values[0].shape[1:])
        for number, part in enumerate(values):
            rows[number :: self.n_ranks] = part.view(-1, *rows.shape[1:])
        return rows.flatten(0, 1)
