"""Where an evaluation plays, and who: agents of runs, packaged agents, and bots."""

import collections
import contextlib
import os
from collections.abc import Sequence
from typing import NamedTuple

import torch

from megastep.agents import console
from megastep.agents.distributed import process_group
from megastep.agents.errors import UserError
from megastep.agents.evaluation import playing
from megastep.agents.factory import components, settings
from megastep.agents.factory import make as factory
from megastep.agents.generator import seed_of
from megastep.agents.runs import checkpoint, folders, restore
from megastep.agents.selfplay.bots import BOTS
from megastep.agents.selfplay.mixed_policy import rotating_teams, teams_of
from megastep.agents.training.callbacks import close_env
from megastep.arrdict import arrdict, cat
from megastep.env_state import way_back
from megastep.types import Env, PolicyLike, optional

#: Settings of an environment for duels, where it has them: two agents, each environment in one
#: home.
FOR_TWO = {"n_agents": 2, "self_play": True, "resample": False}


class Player(NamedTuple):
    """Who plays."""

    name: str
    policy: PolicyLike
    loaded: checkpoint.Checkpoint | None = None  # an agent's

    @property
    def step(self) -> int | None:
        """The number of samples it has learnt from."""
        return self.loaded and self.loaded.step


class Shard:
    """The environments that rank `number` of `n_ranks`, at most N, plays of an evaluation's N.

    Of N environments in D homes, e is in home e mod D, and rank r of R plays r, r + R, r + 2 R, ...
    Together ranks play each home as often as a single process does, with other spawns and actions.

    Attributes:
        envs: indices of its environments among the N.
        homes: indices of its homes among the D; its i-th environment is in `homes[i % len(homes)]`.
    """

    def __init__(self, n_envs: int, n_homes: int, number: int = 0, n_ranks: int = 1):
        self.n_envs, self.n_ranks = n_envs, n_ranks
        self.envs = range(number, n_envs, n_ranks)
        self.homes = [*dict.fromkeys(env % n_homes for env in self.envs)] if n_homes else []

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
        whole = cat(process_group.gather_objects(values))
        n_each = len(next(iter(whole.values()))) // self.n_envs  # lanes per environment
        envs = [env for r in range(self.n_ranks) for env in range(r, self.n_envs, self.n_ranks)]
        rows = torch.tensor(envs).argsort()[:, None] * n_each + torch.arange(n_each)
        return whole[rows.flatten()]


class EvalEnv:
    """An environment in which each home is played equally often, each environment in one home.

    Args:
        homes: geometries; none if the environment takes none.
        episodes: number of episodes, one per lane. If there are fewer environments than homes, they
            are in evenly spaced ones; if more, their number is rounded up to a multiple of homes.
        is_shared: the ranks share the environments. Otherwise each makes all of them.
        is_duel: makes environments for two where the number of agents can be set, an episode each,
            as many in each home as there are teams, or a multiple. UserError for one agent.

    Attributes:
        env, sample: the environment, with this rank's share of all lanes, and a small one.
        homes: the geometries played in.
        own: (n_envs, n_agents) bool, the agents that are evaluated, in duels.
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
        self.seed = seed_of("rank", process_group.rank() if is_shared else 0, seed)
        self.sample = factory.make_sample(env, [*homes], seed=self.seed, device=device)
        n_agents, teams = optional(self.sample, "n_agents"), teams_of(self.sample)
        if is_duel:
            check_duels(self.sample)
            n_teams = len(teams.unique())
            n_homes = max(1, episodes // n_teams)  # from each side
            n_homes -= n_homes % min(n_homes, max(1, len(homes)))
            n_envs = n_homes * n_teams
        else:
            n_envs = -(-episodes // n_agents)
            n_envs += -n_envs % len(homes) if n_envs > len(homes) > 0 else 0
            n_homes = n_envs
        self.homes = factory.spread([*homes], n_homes)
        ranks = process_group.rank(), process_group.n_ranks()
        are_few = not is_shared or ranks[1] > n_envs  # each rank plays all
        self.shard = Shard(n_envs, len(self.homes), *(() if are_few else ranks))
        self.settings = settings.changed(env, n_envs=len(self.shard.envs))
        self.device, self._go_back, self._is_used = device, None, False
        self.env: Env = self._made()
        self.own = rotating_teams(n_envs, teams)[[*self.shard.envs]]

    def _made(self) -> Env:
        homes = [self.homes[home] for home in self.shard.homes]
        where: dict = dict(geometries=homes, device=self.device)
        return factory.construct(self.settings, seed=self.seed, **where)

    def players(
        self, names: Sequence[str], run: checkpoint.Checkpoint, trust: bool
    ) -> list[Player]:
        """Returns who is to play, see `find_player`. Equal names have what was given beside."""
        names = [*dict.fromkeys(names)]
        found = [find_player(name, run, self.settings, self.sample, trust) for name in names]
        counts = collections.Counter(player.name for player in found)
        return [
            Player(
                f"{one.name} ({name})" if counts[one.name] > 1 else one.name,
                factory.in_env(one.policy, self.settings, self.env),
                one.loaded,
            )
            for one, name in zip(found, names, strict=True)
        ]

    def begin(self, run: checkpoint.Checkpoint, *players: Player) -> list[PolicyLike]:
        """Returns players' policies in the environment, set back, with the first's wrappers."""
        policies = [player.policy for player in players]
        if not self._is_used:
            self._go_back = way_back(self.env) if optional(self.env, "resumable") else None
        elif not self._went_back():
            close_env(self.env)
            self.env, self._go_back = self._made(), None
            policies = [factory.in_env(policy, self.settings, self.env) for policy in policies]
        self._is_used = True
        restore.load_wrappers(self.env, players[0].loaded or run)
        return policies

    def _went_back(self) -> bool:
        with contextlib.suppress(ValueError):  # of what a reset has made of others' environments
            if self._go_back is not None:
                self._go_back()
                return True
        return False

    def duel(
        self, cfg: settings.Evaluate, run: checkpoint.Checkpoint, player: Player, opponent: Player
    ) -> arrdict:
        """Returns the duels of two players, those of all ranks."""
        policy, other = self.begin(run, player, opponent)
        how = self.seed, cfg.greedy, cfg.max_steps or playing.MAX_STEPS, self.own
        with factory.errors():
            played = playing.first_duels(self.env, policy, other, *how)
        return self.shard.with_others(played)

    def warn_without_layout(self) -> None:
        """Warns if environments share homes and it is unknown which."""
        is_shared = 1 < len(self.homes) < self.shard.n_envs
        if optional(self.env, "layout") is None and is_shared:
            console.warn(
                f"{type(self.env).__name__} has no `layout`, the home of each environment: "
                "intervals take every environment for a home of its own, and are too narrow"
            )


def check_duels_of(env: settings.Env, device: torch.device) -> None:
    """As `check_duels`, before homes are made: in a box, if the environment fits in one."""
    if not (box := factory.homes(env, components.settings_for("geometry", components.BOX), "test")):
        return
    try:
        sample = factory.make_sample(settings.changed_known(env, **FOR_TWO), box, device=device)
    except UserError:
        return
    check_duels(sample)


def check_duels(env: Env) -> None:
    """Raises UserError if nobody can be met in an environment."""
    if optional(env, "n_agents") < 2:
        raise UserError(
            f"A duel needs an environment with at least two agents, and {type(env).__name__} has "
            "one here; choose another with env= and its settings"
        )


def name_of(loaded: checkpoint.Checkpoint) -> str:
    """Returns how tables name an agent."""
    return f"{folders.name_of(loaded.path)}, {loaded.step:,} samples"


def load_player(loaded: checkpoint.Checkpoint, env: Env, run: checkpoint.Checkpoint) -> Player:
    """Returns the player of a checkpoint, to meet the agent of `run` in `env`, or UserError."""
    trained, own = (components.label(factory.config_of(one).env.name) for one in (loaded, run))
    if trained != own:
        raise UserError(
            f"{loaded.path} was trained in {trained} and {run.path} in {own}; choose a run in the "
            "same environment"
        )
    return Player(name_of(loaded), restore.policy_of(loaded, env), loaded)


def is_bot(name: str) -> bool:
    """Returns whether a name stands for what needs no weights: a bot, or an import path."""
    return name in ("bot", *BOTS) or (":" in name and not os.path.exists(name))


def find_player(
    name: str, run: checkpoint.Checkpoint, env_settings: settings.Env, env: Env, trust: bool
) -> Player:
    """Returns who is to meet the agent of `run` in `env`, or to be compared with it there: a run's
    folder or checkpoint, a pretrained agent, an import path, one of `BOTS`, or `bot`, the
    environment's own. UserError if this player cannot play there.
    """
    if is_bot(name):
        return Player(name, factory.make_bot(name, env_settings, env))
    path = factory.find_or_name_bots(name)
    return load_player(folders.load_checkpoint(path, trust, env.device), env, run)
