"""Environments in which each home is played equally often, each environment in one home."""

from collections.abc import Sequence
from typing import Any

import torch

from megastep.agents import console, factory
from megastep.agents.distributed import process_group
from megastep.agents.distributed.shard import Shard
from megastep.agents.errors import UserError
from megastep.agents.factory import settings
from megastep.agents.generator import rank_seed
from megastep.types import Env, optional

#: Settings of an environment for duels, where it has them: two agents, each environment in one
#: home.
FOR_TWO = {"n_agents": 2, "self_play": True, "resample": False}


class EvalEnv:
    """An environment in which each home is played equally often, each environment in one home.

    Args:
        env: settings of the environment.
        homes: geometries; none if the environment takes none.
        episodes: number of episodes, one per lane. If there are fewer environments than homes, they
            are in evenly spaced ones; if more, their number is rounded up to a multiple of homes.
        seed: of spawns.
        device: a name of PyTorch.
        rank: (number, ranks) whose share of the environments is made. Default: this process's.
        is_duel: makes environments for two where the number of agents can be set, an episode each,
            as many in each home as there are slots, or a multiple.
        options: other arguments of the environment, such as `films`.

    Attributes:
        env, sample: the environment, with this rank's share of all lanes, and a small one.
        settings: those of `env`.
        homes: the geometries played in.
        numbers: the index of each in the list that was given.
        shard: this rank's share.

    Raises:
        UserError: a duel in an environment of one agent.
    """

    def __init__(
        self,
        env: settings.Env,
        homes: Sequence,
        episodes: int,
        seed: int = 1,
        device: torch.device | str = "cpu",
        rank: tuple[int, int] | None = None,
        is_duel: bool = False,
        **options: Any,
    ):
        env = settings.changed_known(env, **(FOR_TWO if is_duel else {"resample": False}))
        self.seed = rank_seed(seed, process_group.rank() if rank is None else rank[0])
        self.sample = factory.make_sample(env, [*homes], seed=self.seed, device=device)
        n_agents = optional(self.sample, "n_agents")
        if is_duel:
            check_duels(self.sample)
            n_each = max(1, episodes // n_agents)  # from each slot
            n_each -= n_each % min(n_each, max(1, len(homes)))
            n_envs, n_homes = n_each * n_agents, n_each
        else:
            n_envs = -(-episodes // n_agents)
            n_envs += -n_envs % len(homes) if n_envs > len(homes) > 0 else 0
            n_homes = n_envs
        self.homes = factory.spread([*homes], n_homes)
        self.numbers = factory.spread([*range(len(homes))], n_homes)
        self.shard = (
            Shard.of_this_rank(n_envs, len(self.homes))
            if rank is None
            else Shard(n_envs, len(self.homes), *rank)
        )
        self.settings = settings.changed(env, n_envs=len(self.shard.envs))
        where = dict(geometries=[self.homes[home] for home in self.shard.homes], device=device)
        self.env: Env = factory.construct(self.settings, seed=self.seed, **where, **options)

    def warn_without_layout(self) -> None:
        """Warns if environments share homes and it is unknown which."""
        is_shared = 1 < len(self.homes) < self.shard.n_envs
        if optional(self.env, "layout") is None and is_shared:
            console.warn(
                f"{type(self.env).__name__} has no `layout`, the home of each environment: "
                "intervals take every environment for a home of its own, and are too narrow"
            )


def check_duels(env: Env) -> None:
    """Raises UserError if nobody can be met in an environment."""
    if optional(env, "n_agents") < 2:
        raise UserError(
            f"A duel needs an environment with at least two agents, and {type(env).__name__} has "
            "one here; choose another with env= and its settings"
        )
