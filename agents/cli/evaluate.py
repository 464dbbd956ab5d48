"""Measures a trained policy on unseen homes, or against others in duels.

`evaluate --help`; `run(cfg)` is the same from Python.
"""

import functools
import itertools
import time
from pathlib import Path
from typing import Any, NamedTuple

from megastep.agents.cli import (
    command,
    components,
    console,
    factory,
    program,
    runs,
    scripts,
    settings,
)
from megastep.agents.distributed import process_group
from megastep.agents.distributed.share import Share
from megastep.agents.generator import rank_seed
from megastep.agents.selfplay import duels, ratings
from megastep.agents.training import checkpoint, evaluation
from megastep.types import optional

#: The source of a suite of which the worst homes have a row of their own.
DENSE = "dense"
#: Columns of a table of duels, and of one of ratings, as templates.
DUELS = {
    "against": "{against}",
    "won": "{won:.3f}",
    runs.INTERVAL: "{lower:.3f} to {upper:.3f}",
    **{name: f"{{{name}}}" for name in ("wins", "draws", "losses")},
    "length": "{length:.0f}",
    "duels": "{duels}",
    "homes": "{homes}",
}
RATINGS = {
    "player": "{player}",
    "rating": "{rating:.2f}",
    "sigma": "{sigma:.2f}",
    "won": "{won:.3f}",
    "duels": "{duels}",
}


def run(cfg: settings.Evaluate) -> Path:
    """Evaluates a run, each environment in one home throughout. Returns the path of the table.

    Of several ranks, each plays its share. Rank 0 writes; the others return the run's folder.

    Writes .json and .md into the run's folder `evaluations`, one of each per source of geometries
    (per environment where it has none), split and checkpoint. Of `geometry=suite` plays as many
    episodes in each source, and adds the worst source and the worst dense homes. With `cfg.against`
    plays duels instead; with `cfg.ratings` writes ratings.csv and ratings.svg.
    """
    start, device = time.monotonic(), factory.make_device(cfg.device)
    loaded = runs.load_checkpoint(runs.find(cfg.run), cfg.trust, device)
    trained = factory.config_of(loaded)
    env_settings = cfg.env or trained.env
    geometry = factory.typed_or(trained.geometry, cfg.geometry, env_settings)
    homes = factory.homes(env_settings, geometry, cfg.split)
    if cfg.ratings:
        path = Arena(cfg, loaded, env_settings, geometry, homes, device).rate()
    elif cfg.against is not None:
        path = duel(cfg, loaded, env_settings, geometry, homes, device)
    else:
        rows = []
        for source, part in parts_of(geometry, homes):
            rows += of_source(source, play(cfg, loaded, env_settings, part, device, source))
        if process_group.rank() > 0:
            return runs.folder_of(loaded.path)
        place = runs.place(env_settings, geometry, homes, cfg.split)
        what, n_homes = f"{rows[0]['lanes']:,} episodes", count_homes(rows)
        rows = with_worst_source(rows, "agent") if is_suite(geometry) else rows
        path = runs.write_table(
            cfg,
            loaded,
            [place.source, "env" if cfg.env else "", cfg.split, str(loaded.step)],
            f"{place.title(what + each_source(geometry), n_homes)}, after {loaded.step:,} samples "
            f"({loaded.path.name}), seed {cfg.seed}",
            rows,
            [*map(cells, rows)],
        )
    console.say(f"Evaluated in {console.duration(time.monotonic() - start)}")
    return path


def play(
    cfg: settings.Evaluate,
    loaded: checkpoint.Checkpoint,
    env_settings: settings.Env,
    homes: list,
    device: Any,
    source: str | None = None,
) -> list[dict]:
    """Plays `cfg.episodes` in homes, in all of a `source` or of several. Returns the table rows."""
    homes = factory.spread(homes, cfg.episodes)
    share = Share.of_this_rank(cfg.episodes, len(homes))
    seed, trained = rank_seed(cfg.seed, process_group.rank()), factory.config_of(loaded)
    env_settings = factory.changed(env_settings, n_envs=len(share.envs), resample=False)
    where = dict(geometries=[homes[home] for home in share.homes], seed=seed, device=device)
    env, rows = factory.construct(env_settings, **where), []
    policy = factory.load_weights(factory.make_policy(trained.agent, env), env, loaded)
    players = [("trained, greedy" if cfg.greedy else "trained", policy, cfg.greedy)]
    players += [("random", evaluation.RandomActions(env.action_space), False)] * cfg.baseline
    sources = None if source else evaluation.sources_of(homes)
    for name, player, greedy in players:
        episodes = share.with_others(evaluation.first_episodes(env, player, seed, greedy))
        summaries = evaluation.summaries(episodes, optional(env, "roles"), sources)
        if source == DENSE and "homes" in episodes:
            summaries.append({"tail": evaluation.TAIL, **evaluation.worst_summary(episodes)})
        rows += [{"agent": name, **row} for row in summaries]
    if process_group.rank() == 0:
        warn_without_layout(env, homes)
    return rows


# ---- The suite, whose sources are evaluated one by one ----


def is_suite(geometry: settings.Geometry) -> bool:
    return geometry.name == components.SUITE


def each_source(geometry: settings.Geometry) -> str:
    return " in each source" if is_suite(geometry) else ""


def parts_of(geometry: settings.Geometry, homes: list) -> list[tuple[str | None, list]]:
    """Returns [(source, its homes)] of a suite, and [(None, homes)] of all other geometries."""
    if not is_suite(geometry):
        return [(None, homes)]
    parts = {}
    for home in homes:
        parts.setdefault(home["source"], []).append(home)
    return [*parts.items()]


def of_source(source: str | None, rows: list[dict]) -> list[dict]:
    return [{**row, "source": source} for row in rows] if source else rows


def count_homes(rows: list[dict]) -> int:
    """Returns the number of homes of the first agent or opponent, over all sources."""
    by_source = {}
    for row in rows:
        by_source.setdefault(row.get("source"), row["homes"] or 0)
    return by_source.get(None) or sum(by_source.values())


def with_worst_source(rows: list[dict], who: str) -> list[dict]:
    """Returns the rows of each agent or opponent, row[who], together, with that of its worst source
    once more at their end.
    """
    ordered = []
    for name in dict.fromkeys(row[who] for row in rows):
        of_one = [row for row in rows if row[who] == name]
        whole = [row for row in of_one if not {"role", "tail"} & row.keys()]
        worst = min(whole, key=evaluation.score_of)
        ordered += [*of_one, {**worst, "is_worst": True}]
    return ordered


def warn_without_layout(env: Any, homes: list) -> None:
    """Warns if environments share homes and it is unknown which."""
    if optional(env, "layout") is None and 1 < len(homes) < env.n_envs:
        console.warn(
            f"{type(env).__name__} has no `layout`, the home of each environment: intervals take "
            "every environment for a home of its own, and are too narrow"
        )


def cells(row: dict) -> dict[str, str]:
    cut, metrics = f", {row['unfinished']} cut short" if row["unfinished"] else "", {}
    for name, metric in row["metrics"].items():
        texts = [f"{value:.3g}" for value in metric.values() if value is not None] or 2 * ["none"]
        metrics |= {name: texts[0], f"{name}: {runs.INTERVAL}": " to ".join(texts[1:])}
    return {
        "agent": f"{row['agent']}{part_of(row)}",
        "return": f"{row['return']:.2f}",
        runs.INTERVAL: f"{row['lower']:.2f} to {row['upper']:.2f}",
        **metrics,
        "length": f"{row['length']:.0f}",
        "episodes": f"{row['lanes']}{cut}",
        "homes": str(row["homes"] or "none"),
    }


def part_of(row: dict) -> str:
    """Returns which of its agent's episodes a row has, `: hunter` or `, in maze`; empty for all."""
    worst = f", worst {row['tail']:.0%} of homes" if "tail" in row else ""
    worst += ", the worst source" * row.get("is_worst", False)
    role = f": {row['role']}" if "role" in row else ""
    return role + (f", in {row['source']}{worst}" if "source" in row else "")


# ---- Duels and ratings ----


class Player(NamedTuple):
    name: str
    policy: Any
    step: int | None = None  # the number of samples it has learnt from


#: Settings of an environment for duels, where it has them: two agents, each environment in one
#: home.
FOR_TWO = {"n_agents": 2, "self_play": True, "resample": False}


def load_player(loaded: checkpoint.Checkpoint, env: Any, run: checkpoint.Checkpoint) -> Player:
    """Returns the player of a checkpoint, to meet the agent of `run` in `env`.

    Raises:
        UserError: if one was trained in another environment.
    """
    trained, own = factory.config_of(loaded), factory.config_of(run)
    if trained.env.name != own.env.name:
        raise program.UserError(
            f"{loaded.path} was trained in {settings.label(trained.env.name)} and {run.path} in "
            f"{settings.label(own.env.name)}; choose a run in the same environment"
        )
    policy = factory.load_weights(factory.make_policy(trained.agent, env), env, loaded)
    return Player(f"{runs.name_of(loaded.path)}, {loaded.step:,} samples", policy, loaded.step)


def find_player(
    name: str, run: checkpoint.Checkpoint, env_settings: settings.Env, env: Any, trust: bool
) -> Player:
    """Returns who is to meet the agent of `run` in `env`.

    Args:
        name: a run's folder or checkpoint, or a pretrained agent; or what needs no weights: an
            import path, `random`, or `bot`, which is the run's `opponents.bot_class`, or else the
            environment's own bot.
        trust: import what a run that another user made names.

    Raises:
        UserError: if nobody can be met there, or this player cannot play there.
    """
    if optional(env, "n_agents") < 2:
        raise program.UserError(
            f"A duel needs an environment with at least two agents, and {type(env).__name__} has "
            "one here; choose another with env= and its settings"
        )
    if name == "bot":
        name = factory.config_of(run).opponents.bot_class or name
    if name in ("bot", "random") or (":" in name and not Path(name).exists()):
        return Player(name, factory.make_bot(None if name == "bot" else name, env_settings, env))
    return load_player(runs.load_checkpoint(runs.find(name), trust, env.device), env, run)


class Arena:
    """An environment in unseen homes, where the agent of a run meets others.

    It has two agents, or as many as it has if their number is fixed. Each home is played in from
    every agent's place, equally often, in up to `cfg.episodes` duels.
    """

    def __init__(
        self,
        cfg,
        run: checkpoint.Checkpoint,
        env: settings.Env,
        geometry: Any,
        homes: list,
        device: Any,
    ):
        self.cfg, self.run, env = cfg, run, factory.changed(env, **FOR_TWO)
        where = dict(seed=cfg.seed, device=device)
        sample = factory.make_sample(env, homes, **where)
        self.others = [find_player(name, run, env, sample, cfg.trust) for name in cfg.against or ()]
        self.agent = load_player(run, sample, run)
        n_agents = optional(sample, "n_agents")
        n_duels = max(1, cfg.episodes // n_agents)  # from each place
        homes = factory.spread(homes, n_duels)
        n_duels -= n_duels % max(1, len(homes))
        self.share = Share.of_this_rank(n_duels * n_agents, len(homes))
        self.seed = rank_seed(cfg.seed, process_group.rank())
        env = factory.changed(env, n_envs=len(self.share.envs))
        where |= dict(geometries=[homes[home] for home in self.share.homes], seed=self.seed)
        self.env, self.sample = factory.construct(env, **where), sample
        slots = duels.rotating_slots(self.share.n_envs, n_agents, self.env.device)
        self.slots = slots[[*self.share.envs]]
        self.place, self.env_settings = runs.place(env, geometry, homes, cfg.split), env
        self.sources = evaluation.sources_of(homes)
        warn_without_layout(self.env, homes)

    def play(self, player: Player, opponent: Player) -> Any:
        policies = player.policy, opponent.policy
        with factory.errors():
            played = duels.play(self.env, *policies, self.seed, self.cfg.greedy, slots=self.slots)
        return self.share.with_others(played)

    def duel(self, source: str | None = None) -> list[dict]:
        """Plays the run's agent against each of `cfg.against`, in homes of a `source` or of
        several. Returns the table rows.
        """
        roles, rows = optional(self.env, "roles"), []
        for opponent in self.others:
            played = self.play(self.agent, opponent)
            summaries = duels.summaries(played, roles, None if source else self.sources)
            if source == DENSE and "homes" in played:
                summaries.append({"tail": evaluation.TAIL, **duels.worst_summary(played)})
            rows += [{"against": opponent.name, **row} for row in summaries]
        return rows

    def rate(self) -> Path:
        """Rates the run's snapshots, or else its checkpoints, and those of `cfg.against`, by duels
        of each with each. Prints a table, writes ratings.csv and ratings.svg into the run's
        folder, and returns the path of the first.
        """
        folder, players = runs.folder_of(self.run.path), []
        for path in (
            checkpoint.list_checkpoints(folder / "snapshots")
            or checkpoint.list_checkpoints(folder / "checkpoints")
            or [self.run.path]  # the file of an agent
        ):
            player = find_player(str(path), self.run, None, self.sample, self.cfg.trust)
            players.append(player._replace(name=f"{player.step:,} samples"))
        players += self.others
        if len(players) < 2:
            raise program.UserError(
                f"{folder} has one checkpoint and nothing to compare it with: train with "
                "snapshots=8, or name others with against="
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
        layouts, what = played[0, 1].get("homes"), f"{self.share.n_envs:,} duels of each pair"
        n_homes = None if layouts is None else len(layouts.unique())
        title = f"Ratings in {self.place.title(what, n_homes)}, seed {self.cfg.seed}"
        table = console.table(
            [*RATINGS], [[form.format_map(row) for form in RATINGS.values()] for row in rows]
        )
        console.say(f"{title}\n{table}")
        with program.errors(f"{folder} cannot be written: "):
            folder.mkdir(parents=True, exist_ok=True)
            ratings.write(folder, rows, title)
        console.say(f"Plot: {folder / 'ratings.svg'}")
        return folder / "ratings.csv"


def duel(
    cfg: settings.Evaluate,
    run: checkpoint.Checkpoint,
    env: settings.Env,
    geometry: settings.Geometry,
    homes: list,
    device: Any,
) -> Path:
    """Plays the run's agent against each of `cfg.against`, of a suite in each source. Prints and
    writes a table, and returns the path of its .json.
    """
    rows = []
    for source, part in parts_of(geometry, homes):
        arena = Arena(cfg, run, env, geometry, part, device)
        rows += of_source(source, arena.duel(source))
    if process_group.rank() > 0:
        return runs.folder_of(run.path)
    place = runs.place(arena.env_settings, geometry, homes, cfg.split)
    title = place.title(f"{rows[0]['duels']:,} duels{each_source(geometry)}", count_homes(rows))
    rows = with_worst_source(rows, "against") if is_suite(geometry) else rows
    return runs.write_table(
        cfg,
        run,
        ["duels", place.source, cfg.split, str(run.step), "against", *cfg.against],
        f"{arena.agent.name}, in {title}, seed {cfg.seed}",
        rows,
        [*map(duel_cells, rows)],
    )


def duel_cells(row: dict) -> dict[str, str]:
    against = f"{row['against']}{part_of(row).replace(': ', ', as ')}"
    row = row | {"against": against, "homes": row["homes"] or "none"}
    return {key: form.format_map(row) for key, form in DUELS.items()}


#: Runs the script with words of a command line, by default this process's.
main = functools.partial(command.run_command, scripts.EVALUATE)
