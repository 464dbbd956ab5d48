"""Duels and ratings of trained policies: what `evaluate.py` does with `against` and `ratings`."""

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any

from megastep.agents.cli import factory, run_folders, tables
from megastep.agents.cli.console import duration, say, table
from megastep.agents.cli.errors import UserError
from megastep.agents.cli.registry import label
from megastep.agents.cli.settings import Evaluate, Geometry
from megastep.agents.selfplay import duels, ratings
from megastep.agents.training import checkpoint, evaluation

HEAD = "against", "won", tables.INTERVAL, "wins", "draws", "losses", "length", "duels", "homes"
RATED = "player", "rating", "sigma", "won", "duels"


@dataclasses.dataclass(frozen=True)
class Player:
    """A policy under a name; `step`, the samples that it has learnt from, None for a scripted
    one.
    """

    name: str
    policy: Any
    step: int | None = None


class Players:
    """Those who can play in `env`, of the settings `chosen`: of the kind that a run's checkpoint,
    `loaded`, was trained in.
    """

    def __init__(self, loaded: checkpoint.Checkpoint, chosen: Any, env: Any):
        self.loaded, self.chosen, self.env = loaded, chosen, env
        self.trained = factory.config_of(loaded)

    def named(self, name: str) -> Player:
        """A run's agent, by its folder or a checkpoint; or who needs no weights: an import path,
        `random`, or `bot`, whom the run may have met in training. UserError if it cannot play.
        """
        if name == "bot":
            name = self.trained.opponents.bot_class
        if name == "random" or (":" in name and not Path(name).exists()):
            return Player(name, factory.make_bot(name, self.chosen, self.env))
        return self.learnt(factory.load_checkpoint(run_folders.find(name), self.env.device))

    def learnt(self, loaded: checkpoint.Checkpoint) -> Player:
        """The player that a checkpoint holds. UserError if it is from another environment."""
        trained = factory.config_of(loaded)
        if trained.env.name != self.trained.env.name:
            raise UserError(
                f"{loaded.path} was trained in {label(trained.env.name)} and {self.loaded.path} in "
                f"{label(self.trained.env.name)}; name a run in the same environment"
            )
        policy = factory.make_actor(trained.agent, self.env)
        factory.load_weights(policy, self.env, loaded)
        run = run_folders.folder_of(loaded.path).name
        return Player(f"{run}, {loaded.step:,} samples", policy, loaded.step)


class Arena:
    """An environment in unseen homes where a run's agent meets others: of two agents, or of as many
    as it has if that is fixed.

    Each home is played in from every agent's place, equally often: of `cfg.episodes` duels as many as
    can be.
    """

    def __init__(self, cfg: Evaluate):
        self.cfg, device = cfg, factory.make_device(cfg.device)
        path = run_folders.find(cfg.run)
        self.folder, self.loaded = (
            run_folders.folder_of(path),
            factory.load_checkpoint(path, device),
        )
        trained = factory.config_of(self.loaded)
        chosen = for_duels(cfg.env or trained.env)
        self.geometry = cfg.geometry or trained.geometry
        homes = factory.homes(chosen, self.geometry, cfg.split)
        sample = factory.make_sample(chosen, homes, cfg.seed, device)
        check_agents(sample)
        self.players = Players(self.loaded, chosen, sample)
        each = max(1, cfg.episodes // sample.n_agents)
        homes = homes[:each]
        each -= each % max(1, len(homes))
        self.chosen = dataclasses.replace(chosen, n_envs=each * sample.n_agents)
        self.homes = homes
        self.env = factory.make_env(self.chosen, homes, cfg.seed, device)

    def play(self, player: Player, opponent: Player) -> Any:
        """Their duels, as `duels.play` gives them."""
        cfg = self.cfg
        with factory.errors():
            return duels.play(self.env, player.policy, opponent.policy, cfg.seed, cfg.greedy)

    @property
    def where(self) -> str:
        """The environment and its homes, for titles."""
        name = label(self.chosen.name)
        if not self.homes:
            return name
        which = "all" if self.cfg.split == "all" else f"the {self.cfg.split}"
        return f"{name} in {which} homes of {source(self.geometry)}"

    def file(self, kind: str, *names: str) -> str:
        """The name of a table's file, of at most 200 characters."""
        homes = source(self.geometry) if self.homes else label(self.chosen.name)
        words = [kind, homes, self.cfg.split, *names, *(["greedy"] if self.cfg.greedy else [])]
        return "".join(c if c.isalnum() or c in "._-" else "-" for c in "-".join(words))[:200]


def check_agents(env: Any) -> None:
    """UserError if nobody can be met in an environment."""
    if env.n_agents < 2:
        raise UserError(
            f"A duel needs an environment of two agents or more, and {type(env).__name__} as it is "
            "set has one; env= and its settings choose another"
        )


def for_duels(env: Any) -> Any:
    """An environment's settings for two agents, where their number is a setting, who stay in the
    homes they start in.
    """
    fixed = dict(n_agents=2, resample=False)
    return dataclasses.replace(env, **{k: v for k, v in fixed.items() if hasattr(env, k)})


def source(geometry: Geometry) -> str:
    """The name of the geometries evaluated in, for titles and file names."""
    name, path = label(geometry.name), getattr(geometry, "path", None)
    return name if path is None else f"{name}-{Path(path).stem}"


# ---- Against others ----


def run(cfg: Evaluate) -> Path:
    """Plays a run's agent against each of `cfg.against`. Prints the table and writes it to the
    run's folder `evaluations`; returns the path of the .json.
    """
    arena, start = Arena(cfg), time.monotonic()
    agent = arena.players.learnt(arena.loaded)
    opponents = [arena.players.named(name) for name in cfg.against]
    rows = [{"against": each.name, **summary(arena.play(agent, each))} for each in opponents]
    title = f"{agent.name}: duels of {arena.where}, seed {cfg.seed}"
    say(title)
    lines = [cells(row) for row in rows]
    say(table(HEAD, lines))
    say(f"played in {duration(time.monotonic() - start)}")
    result = dict(
        title=title,
        checkpoint=str(arena.loaded.path),
        step=arena.loaded.step,
        evaluation=dataclasses.asdict(cfg),
        rows=rows,
    )
    name = arena.file("duels", str(arena.loaded.step), "against", *cfg.against)
    return tables.write(arena.folder / "evaluations", name, result, HEAD, lines)


def summary(played: dict) -> dict:
    """A table's row for what `duels.play` gave: the share won, a draw being half, with its 95 %
    interval over homes, or over duels where there are none.
    """
    score = played["score"].cpu().numpy()
    homes = played["homes"].cpu().numpy() if "homes" in played else None
    mean, lower, upper = evaluation.interval(score, homes)
    counts = {name: int((score == worth).sum()) for name, worth in (("wins", 1), ("losses", 0))}
    return {
        "won": mean,
        "lower": lower,
        "upper": upper,
        **counts,
        "draws": len(score) - sum(counts.values()),
        "length": float(played["lengths"].mean()),
        "duels": len(score),
        "homes": None if homes is None else len(set(homes.tolist())),
    }


def cells(row: dict) -> tuple[str, ...]:
    """A row of the table, as text."""
    return (
        row["against"],
        f"{row['won']:.3f}",
        f"{row['lower']:.3f} to {row['upper']:.3f}",
        *(str(row[key]) for key in ("wins", "draws", "losses")),
        f"{row['length']:.0f}",
        str(row["duels"]),
        "none" if row["homes"] is None else str(row["homes"]),
    )


# ---- Ratings ----


def rate(cfg: Evaluate) -> Path:
    """Rates a run's snapshots, or else its checkpoints, and whoever is in `cfg.against`, by duels
    of each with each. Prints a table and leaves `ratings.csv` and `ratings.svg` in the run's
    folder; returns the path of the first.
    """
    arena, start = Arena(cfg), time.monotonic()
    snapshots, checkpoints = (
        checkpoint.list_checkpoints(arena.folder / name) for name in ("snapshots", "checkpoints")
    )
    paths, names = snapshots or checkpoints, cfg.against or ()
    if len(paths) + len(names) < 2:
        raise UserError(
            f"{arena.folder} has one checkpoint and nobody to compare it with: train with "
            "snapshots=8, or name others with against="
        )
    loaded = [factory.load_checkpoint(path, arena.env.device) for path in paths]
    players = [
        dataclasses.replace(arena.players.learnt(each), name=f"{each.step:,} samples")
        for each in loaded
    ]
    players += [arena.players.named(name) for name in names]
    scores = {
        (i, j): arena.play(players[i], players[j])["score"].tolist()
        for i, j in itertools.combinations(range(len(players)), 2)
    }
    rows = ratings.rows([(each.name, each.step) for each in players], scores, cfg.seed)
    title = f"Ratings by duels of {arena.where}, seed {cfg.seed}"
    say(title)
    say(table(RATED, [rated_cells(row) for row in rows]))
    say(f"played in {duration(time.monotonic() - start)}")
    try:
        ratings.write(arena.folder, rows, title)
    except OSError as error:
        raise UserError(
            f"The ratings cannot be written to {arena.folder} ({error.strerror})"
        ) from error
    say(f"Plotted: {arena.folder / 'ratings.svg'}")
    return arena.folder / "ratings.csv"


def rated_cells(row: dict) -> tuple[str, ...]:
    return (
        row["player"],
        f"{row['rating']:.2f}",
        f"{row['sigma']:.2f}",
        f"{row['won']:.3f}",
        str(row["duels"]),
    )


def listed(word: str) -> str:
    """`against=B,C,bot` as the list of names that it stands for, not the sweep that Hydra takes it
    for.
    """
    key, _, names = word.partition("=")
    return word if names.startswith("[") or names == "null" else f"{key}=[{names}]"
