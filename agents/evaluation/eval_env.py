"""Where an evaluation plays, and who: agents of runs, packaged agents, and bots."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from megastep.agents import console, factory
from megastep.agents.distributed import process_group
from megastep.agents.distributed.shard import Shard
from megastep.agents.errors import UserError
from megastep.agents.factory import settings
from megastep.agents.generator import rank_seed
from megastep.agents.runs import checkpoint, folders, restore
from megastep.agents.selfplay.bots import BOTS
from megastep.types import Env, PolicyLike, optional

#: Settings of an environment for duels, where it has them: two agents, each environment in one
#: home.
FOR_TWO = {"n_agents": 2, "self_play": True, "resample": False}


class Player(NamedTuple):
    """Who plays."""

    name: str
    policy: PolicyLike
    step: int | None = None  # the number of samples it has learnt from


class EvalEnv:
    """An environment in which each home is played equally often, each environment in one home.

    Args:
        homes: geometries; none if the environment takes none.
        episodes: number of episodes, one per lane. If there are fewer environments than homes, they
            are in evenly spaced ones; if more, their number is rounded up to a multiple of homes.
        seed: of spawns.
        is_shared: the ranks share the environments. Otherwise each makes all of them.
        is_duel: makes environments for two where the number of agents can be set, an episode each,
            as many in each home as there are slots, or a multiple. Raises UserError for one agent.

    Attributes:
        env, sample: the environment, with this rank's share of all lanes, and a small one.
        settings: those of `env`.
        homes, numbers: the geometries played in, and the index of each in the list given.
        shard: this rank's share.
    """

    def __init__(
        self,
        env: settings.Env,
        homes: Sequence,
        episodes: int,
        seed: int = 1,
        device: torch.device | str = "cpu",
        is_shared: bool = True,
        is_duel: bool = False,
    ):
        env = settings.changed_known(env, **(FOR_TWO if is_duel else {"resample": False}))
        self.seed = rank_seed(seed, process_group.rank() if is_shared else 0)
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
        self.shard = (Shard.of_this_rank if is_shared else Shard)(n_envs, len(self.homes))
        self.settings = settings.changed(env, n_envs=len(self.shard.envs))
        where = dict(geometries=[self.homes[home] for home in self.shard.homes], device=device)
        self.env: Env = factory.construct(self.settings, seed=self.seed, **where)

    def find_player(self, name: str, run: checkpoint.Checkpoint, trust: bool) -> Player:
        """Returns who is to play in the environment, see `find_player`."""
        player = find_player(name, run, self.settings, self.sample, trust)
        return player._replace(policy=factory.in_env(player.policy, self.settings, self.env))

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


def load_player(loaded: checkpoint.Checkpoint, env: Env, run: checkpoint.Checkpoint) -> Player:
    """Returns the player of a checkpoint, to meet the agent of `run` in `env`. Raises UserError if
    one was trained in another environment.
    """
    trained, own = factory.config_of(loaded), factory.config_of(run)
    if trained.env.name != own.env.name:
        raise UserError(
            f"{loaded.path} was trained in {settings.label(trained.env.name)} and {run.path} in "
            f"{settings.label(own.env.name)}; choose a run in the same environment"
        )
    name = f"{folders.name_of(loaded.path)}, {loaded.step:,} samples"
    return Player(name, restore.policy_of(loaded, env), loaded.step)


def find_player(
    name: str, run: checkpoint.Checkpoint, env_settings: settings.Env, env: Env, trust: bool
) -> Player:
    """Returns who is to meet the agent of `run` in `env`, or to be compared with it there.

    Args:
        name: a run's folder or checkpoint, or a pretrained agent; or what needs no weights: an
            import path, one of `BOTS`, or `bot`, which is the run's `opponents.bot_class`, or else
            the environment's own bot.
        trust: import what a run that another user made names.

    Raises:
        UserError: if this player cannot play there.
    """
    if name == "bot":
        name = factory.config_of(run).opponents.bot_class or name
    if name in ("bot", *BOTS) or (":" in name and not Path(name).exists()):
        return Player(name, factory.make_bot(None if name == "bot" else name, env_settings, env))
    return load_player(folders.load_checkpoint(folders.find(name), trust, env.device), env, run)
