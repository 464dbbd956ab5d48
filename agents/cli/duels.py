"""Duels and ratings of trained policies: what `evaluate.py` does with `against` and `ratings`."""

import itertools
from pathlib import Path
from typing import Any, NamedTuple

from megastep.agents.cli import factory, runs
from megastep.agents.cli.console import say, table
from megastep.agents.cli.program import UserError
from megastep.agents.cli.settings import Env, Evaluate, Geometry, label
from megastep.agents.selfplay import duels, ratings
from megastep.agents.training import evaluation
from megastep.agents.training.checkpoint import Checkpoint, checkpoints

RATINGS = {"player": "", "rating": ".2f", "sigma": ".2f", "won": ".3f", "duels": ""}


class Player(NamedTuple):
    """A policy under a name. `step` is the number of samples it has learnt from."""

    name: str
    policy: Any
    step: int | None = None


def for_two(settings: Env) -> Env:
    """Returns settings for two agents, if their number is a setting, who stay in their home."""
    return factory.changed(settings, n_agents=2, resample=False)


def check_agents(env: Any) -> None:
    """Raises UserError if an environment has a single agent."""
    if env.n_agents < 2:
        raise UserError(
            f"A duel needs an environment with at least two agents, and {type(env).__name__} has "
            "one here; choose another with env= and its settings"
        )


def load_player(loaded: Checkpoint, env: Any, run: Checkpoint | None = None) -> Player:
    """Returns the player of a checkpoint. Raises UserError if it is from another environment than
    that of `run`, which it is to meet.
    """
    trained = factory.config_of(loaded)
    if run and trained.env.name != (own := factory.config_of(run).env.name):
        raise UserError(
            f"{loaded.path} was trained in {label(trained.env.name)} and {run.path} in "
            f"{label(own)}; choose a run in the same environment"
        )
    policy = factory.make_policy(trained.agent, env)
    factory.load_weights(policy, env, loaded)
    folder = runs.folder_of(loaded.path).name
    return Player(f"{folder}, {loaded.step:,} samples", policy, loaded.step)


def find_player(name: str, run: Checkpoint, settings: Env, env: Any) -> Player:
    """Returns who is to play in `env` against the agent of `run`.

    Args:
        name: a run's folder or checkpoint; an import path, `random`, or `bot`, the scripted policy
            of the run, none of which needs weights.
    """
    if name == "bot":
        name = factory.config_of(run).opponents.bot_class
    if name == "random" or (":" in name and not Path(name).exists()):
        return Player(name, factory.make_bot(name, settings, env))
    return load_player(factory.load_checkpoint(runs.find(name), env.device), env, run)


class Arena:
    """An environment in unseen homes, where the agent of a run meets others.

    It has two agents, or as many as it has if their number is fixed. Each home is played in from
    every agent's place, equally often, in up to `cfg.episodes` duels.
    """

    def __init__(
        self, cfg: Evaluate, run: Checkpoint, settings: Env, geometry: Geometry, device: Any
    ):
        self.cfg, self.run, settings = cfg, run, for_two(settings)
        homes = factory.homes(settings, geometry, cfg.split)
        self.sample = factory.make_sample(settings, homes, cfg.seed, device)
        check_agents(self.sample)
        n_duels = max(1, cfg.episodes // self.sample.n_agents)  # from each place
        homes = homes[:n_duels]
        n_envs = (n_duels - n_duels % max(1, len(homes))) * self.sample.n_agents
        self.settings = factory.changed(settings, n_envs=n_envs)
        self.env = factory.make_env(self.settings, homes, cfg.seed, device)
        self.where, self.source = runs.place(settings, geometry, homes, cfg.split)

    def players(self) -> list[Player]:
        """Returns those named by `cfg.against`."""
        names = self.cfg.against or ()
        return [find_player(name, self.run, self.settings, self.sample) for name in names]

    def play(self, player: Player, opponent: Player) -> Any:
        """Returns their duels, as `duels.play` does."""
        policies = player.policy, opponent.policy
        with factory.errors():
            return duels.play(self.env, *policies, self.cfg.seed, self.cfg.greedy)

    def duel(self) -> Path:
        """Plays the run's agent against each of `cfg.against`. Prints and writes a table, and
        returns the path of its .json.
        """
        agent, opponents = load_player(self.run, self.sample), self.players()
        rows = [{"against": one.name, **summary(self.play(agent, one))} for one in opponents]
        title = f"{agent.name}: duels of {self.where}, seed {self.cfg.seed}"
        names = ["duels", self.source, self.cfg.split, str(self.run.step), "against"]
        names += self.cfg.against
        return runs.write_table(self.cfg, self.run, names, title, rows, [cells(row) for row in rows])

    def rate(self) -> Path:
        """Rates the run's snapshots, or else its checkpoints, and those of `cfg.against`, by duels
        of each with each. Prints a table, writes ratings.csv and ratings.svg into the run's folder,
        and returns the path of the first.
        """
        folder, others = runs.folder_of(self.run.path), self.players()
        paths = checkpoints(folder / "snapshots") or checkpoints(folder / "checkpoints")
        if len(paths) + len(others) < 2:
            raise UserError(
                f"{folder} has one checkpoint and nothing to compare it with: train with "
                "snapshots=8, or name others with against="
            )
        loaded = [factory.load_checkpoint(path, self.env.device) for path in paths]
        players = [load_player(one, self.sample, self.run) for one in loaded]
        players = [one._replace(name=f"{one.step:,} samples") for one in players] + others
        scores = {
            (i, j): self.play(players[i], players[j])["score"].tolist()
            for i, j in itertools.combinations(range(len(players)), 2)
        }
        rows = ratings.rows([(one.name, one.step) for one in players], scores, self.cfg.seed)
        title = f"Ratings by duels of {self.where}, seed {self.cfg.seed}"
        lines = [[format(row[key], form) for key, form in RATINGS.items()] for row in rows]
        say(f"{title}\n{table([*RATINGS], lines)}")
        with runs.writing(folder, ""):
            ratings.write(folder, rows, title)
        say(f"Plot: {folder / 'ratings.svg'}")
        return folder / "ratings.csv"


def summary(played: dict) -> dict:
    """Returns a table's row for what `duels.play` returned: the share won, a draw counting half,
    with its 95 % interval over homes, or over duels where there are none.
    """
    score = played["score"].cpu().numpy()
    homes = played["homes"].cpu().numpy() if "homes" in played else None
    mean, lower, upper = evaluation.interval(score, homes)
    return {
        "won": mean,
        "lower": lower,
        "upper": upper,
        "wins": int((score == 1).sum()),
        "losses": int((score == 0).sum()),
        "draws": int(((score != 1) & (score != 0)).sum()),
        "length": float(played["lengths"].mean()),
        "duels": len(score),
        "homes": None if homes is None else len(set(homes.tolist())),
    }


def cells(row: dict) -> dict[str, str]:
    """Returns a row of the table as text, by column."""
    return {
        "against": row["against"],
        "won": f"{row['won']:.3f}",
        runs.INTERVAL: f"{row['lower']:.3f} to {row['upper']:.3f}",
        **{key: str(row[key]) for key in ("wins", "draws", "losses")},
        "length": f"{row['length']:.0f}",
        "duels": str(row["duels"]),
        "homes": str(row["homes"] or "none"),
    }
