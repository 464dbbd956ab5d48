"""Environments in unseen homes, where the agent of a run plays alone or meets others."""

import functools
import itertools
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from megastep.agents import console, factory
from megastep.agents.distributed import process_group
from megastep.agents.distributed.shard import Shard
from megastep.agents.errors import UserError, user_errors
from megastep.agents.evaluation import duels, playing, ratings, statistics, suite, tables
from megastep.agents.factory import settings
from megastep.agents.generator import rank_seed
from megastep.agents.runs import checkpoint, folders
from megastep.agents.selfplay.bots import BOTS
from megastep.agents.selfplay.slots import rotating_slots
from megastep.arrdict import arrdict
from megastep.types import Env, PolicyLike, optional


class Player(NamedTuple):
    name: str
    policy: PolicyLike
    step: int | None = None  # the number of samples it has learnt from


#: Settings of an environment for duels, where it has them: two agents, each environment in one
#: home.
FOR_TWO = {"n_agents": 2, "self_play": True, "resample": False}


def load_player(loaded: checkpoint.Checkpoint, env: Env, run: checkpoint.Checkpoint) -> Player:
    """Returns the player of a checkpoint, to meet the agent of `run` in `env`.

    Raises:
        UserError: if one was trained in another environment.
    """
    trained, own = factory.config_of(loaded), factory.config_of(run)
    if trained.env.name != own.env.name:
        raise UserError(
            f"{loaded.path} was trained in {settings.label(trained.env.name)} and {run.path} in "
            f"{settings.label(own.env.name)}; choose a run in the same environment"
        )
    policy = factory.load_weights(factory.make_policy(trained.agent, env), env, loaded)
    if _of_wrappers(loaded) != _of_wrappers(run):
        warnings.warn(
            f"{loaded.path} observes through what the wrappers of {run.path} have learnt, not its "
            "own",
            stacklevel=3,
        )
    return Player(f"{folders.name_of(loaded.path)}, {loaded.step:,} samples", policy, loaded.step)


def _of_wrappers(loaded) -> dict:
    state = (loaded.state or {}).get("wrappers", {})
    return {name: torch.as_tensor(value).tolist() for name, value in state.items()}


def find_player(
    name: str, run: checkpoint.Checkpoint, env_settings: settings.Env | None, env: Env, trust: bool
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
        assert env_settings is not None
        return Player(name, factory.make_bot(None if name == "bot" else name, env_settings, env))
    return load_player(folders.load_checkpoint(folders.find(name), trust, env.device), env, run)


class Stage:
    """An environment in which each home is played equally often, each environment in one home.

    Args:
        env: settings of the environment.
        homes: geometries; none if the environment takes none.
        episodes: number of episodes, one per lane. If there are fewer environments than homes, they
            are in evenly spaced ones; if more, their number is rounded up to a multiple of homes.
        seed: of spawns.
        device: a name of PyTorch.
        rank: (number, ranks) whose share of the environments is made. Default: this process's.
        options: other arguments of the environment, such as `films`.

    Attributes:
        env, sample: the environment, with this rank's share of all lanes, and a small one.
        settings: those of `env`.
        homes: the geometries played in.
        numbers: the index of each in the list that was given.
        shard: this rank's share.
    """

    def __init__(
        self,
        env: settings.Env,
        homes: Sequence,
        episodes: int,
        seed: int = 1,
        device: torch.device | str = "cpu",
        rank: tuple[int, int] | None = None,
        **options,
    ):
        self.seed = rank_seed(seed, process_group.rank() if rank is None else rank[0])
        self.sample = factory.make_sample(env, [*homes], seed=self.seed, device=device)
        n_envs = -(-episodes // optional(self.sample, "n_agents"))
        n_envs += -n_envs % len(homes) if n_envs > len(homes) > 0 else 0
        self.homes = factory.spread([*homes], n_envs)
        self.numbers = factory.spread([*range(len(homes))], n_envs)
        self.shard = (
            Shard.of_this_rank(n_envs, len(self.homes))
            if rank is None
            else Shard(n_envs, len(self.homes), *rank)
        )
        self.settings = settings.changed(env, n_envs=len(self.shard.envs), resample=False)
        where = dict(geometries=[self.homes[home] for home in self.shard.homes], device=device)
        self.env: Env = factory.construct(self.settings, seed=self.seed, **where, **options)

    def play(
        self,
        policy: PolicyLike,
        greedy: bool,
        max_steps: int | None = None,
        recorder: playing.Recorder | None = None,
    ) -> arrdict:
        """Returns the first episodes of all lanes, see `playing.first_episodes`, of all ranks."""
        played = playing.first_episodes(self.env, policy, self.seed, greedy, max_steps, recorder)
        return self.shard.with_others(played)

    def actions(self, recorder: playing.Recorder) -> playing.Actions | None:
        """Returns the actions of all ranks; None if those of one are too many to keep."""
        own = recorder.actions()
        n_steps = None if own is None else len(next(iter(own.values())))
        is_alone = self.shard.n_ranks == 1
        lengths = [n_steps] if is_alone else process_group.gather_objects(n_steps)
        if own is None or None in lengths:
            return None
        longest = max(length for length in lengths if length is not None)
        if is_alone:
            return playing.Actions(own)
        wide = {}
        for name, steps in own.items():
            steps = np.pad(steps, [(0, longest - len(steps)), *[(0, 0)] * (steps.ndim - 1)])
            dtype = np.int64 if steps.dtype.kind in "iu" else steps.dtype  # ranks may differ
            wide[name] = torch.as_tensor(steps.astype(dtype)).transpose(0, 1)
        every = self.shard.with_others(arrdict(wide))
        leaves = {name: lanes.transpose(0, 1).numpy() for name, lanes in every.items()}
        return playing.Actions(leaves, self.shard.n_ranks)


def check_duels(env: Env) -> None:
    """Raises UserError if nobody can be met in an environment."""
    if optional(env, "n_agents") < 2:
        raise UserError(
            f"A duel needs an environment with at least two agents, and {type(env).__name__} has "
            "one here; choose another with env= and its settings"
        )


class Arena:
    """An environment in unseen homes, where the agent of a run meets others.

    It has two agents, or as many as it has if their number is fixed. Each home is played in from
    every agent's slot, equally often, in up to `cfg.episodes` duels.
    """

    def __init__(
        self,
        cfg,
        run: checkpoint.Checkpoint,
        env: settings.Env,
        geometry: settings.Geometry,
        homes: list,
        device: torch.device,
    ):
        self.cfg, self.run, env = cfg, run, settings.changed(env, **FOR_TWO)
        where = dict(seed=cfg.seed, device=device)
        sample = factory.make_sample(env, homes, **where)
        check_duels(sample)
        self.others = [find_player(name, run, env, sample, cfg.trust) for name in cfg.against or ()]
        self.agent = load_player(run, sample, run)
        n_agents = optional(sample, "n_agents")
        n_duels = max(1, cfg.episodes // n_agents)  # from each slot
        homes = factory.spread(homes, n_duels)
        n_duels -= n_duels % max(1, len(homes))
        self.shard = Shard.of_this_rank(n_duels * n_agents, len(homes))
        self.seed = rank_seed(cfg.seed, process_group.rank())
        env = settings.changed(env, n_envs=len(self.shard.envs))
        where |= dict(geometries=[homes[home] for home in self.shard.homes], seed=self.seed)
        self.env, self.sample = factory.construct(env, **where), sample
        factory.load_wrappers(self.env, run)
        self.others = [
            player._replace(policy=factory.in_env(player.policy, env, self.env))
            for player in self.others
        ]
        slots = rotating_slots(self.shard.n_envs, n_agents, self.env.device)
        self.slots = slots[[*self.shard.envs]]
        self.labels, self.env_settings = tables.labels(env, geometry, homes, cfg.split), env
        self.sources = factory.sources_of(homes)
        warn_without_layout(self.env, homes)

    def play(self, player: Player, opponent: Player) -> arrdict:
        """Returns the duels of two players, those of all ranks."""
        policies = player.policy, opponent.policy
        with factory.errors():
            limit = self.cfg.max_steps or duels.MAX_STEPS
            play = functools.partial(duels.play, max_steps=limit, slots=self.slots)
            played = play(self.env, *policies, self.seed, self.cfg.greedy)
        return self.shard.with_others(played)

    def duel(self, source: str | None = None) -> list[dict]:
        """Plays the run's agent against each of `cfg.against`, in homes of a `source` or of
        several. Returns the table rows.
        """
        roles, rows = optional(self.env, "roles"), []
        for opponent in self.others:
            played = self.play(self.agent, opponent)
            summaries = duels.summaries(played, roles, None if source else self.sources)
            if source == suite.DENSE and "homes" in played:
                summaries.append({"tail": statistics.TAIL, **duels.worst_summary(played)})
            rows += [{"against": opponent.name, **row} for row in summaries]
        return rows

    def rate(self) -> Path:
        """Rates the run's snapshots, or else its checkpoints, and those of `cfg.against`, by duels
        of each with each. Prints a table, writes ratings.csv and ratings.svg into the run's
        folder, and returns the path of the first.
        """
        folder, players = folders.folder_of(self.run.path), []
        for path in (
            checkpoint.list_checkpoints(folder / "snapshots")
            or checkpoint.list_checkpoints(folder / "checkpoints")
            or [self.run.path]  # the file of an agent
        ):
            try:
                player = find_player(str(path), self.run, None, self.sample, self.cfg.trust)
            except UserError:
                if path.exists():
                    raise
                continue  # its run, which is training, has deleted it
            players.append(player._replace(name=f"{player.step:,} samples"))
        players += self.others
        if len(players) < 2:
            raise UserError(
                f"{folder} has one checkpoint and nothing to compare it with: train with "
                "checkpoints.snapshots=8, or name others with against="
            )
        played = {
            (i, j): self.play(players[i], players[j])
            for i, j in itertools.combinations(range(len(players)), 2)
        }
        scores = {pair: one["score"].tolist() for pair, one in played.items()}
        if process_group.rank() > 0:
            return folder
        rows = ratings.rows(
            [(player.name, player.step) for player in players], scores, self.cfg.seed
        )
        layouts, what = played[0, 1].get("homes"), f"{self.shard.n_envs:,} duels of each pair"
        n_homes = None if layouts is None else len(layouts.unique())
        title = f"Ratings in {self.labels.title(what, n_homes)}, seed {self.cfg.seed}"
        cells = [[form.format_map(row) for form in tables.RATINGS.values()] for row in rows]
        table = console.table([*tables.RATINGS], cells)
        console.say(f"{title}\n{table}")
        with user_errors(f"{folder} cannot be written: "):
            folder.mkdir(parents=True, exist_ok=True)
            ratings.write(folder, rows, title)
        console.say(f"Plot: {folder / 'ratings.svg'}")
        return folder / "ratings.csv"


def warn_without_layout(env: Env, homes: list) -> None:
    """Warns if environments share homes and it is unknown which."""
    if optional(env, "layout") is None and 1 < len(homes) < env.n_envs:
        console.warn(
            f"{type(env).__name__} has no `layout`, the home of each environment: intervals take "
            "every environment for a home of its own, and are too narrow"
        )
