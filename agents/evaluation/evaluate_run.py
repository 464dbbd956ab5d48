"""Measures a trained policy on unseen homes, or against others in duels."""

import itertools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from megastep.agents import console
from megastep.agents.distributed import process_group
from megastep.agents.errors import UserError
from megastep.agents.evaluation import eval_env, playing, statistics, tables
from megastep.agents.evaluation.eval_env import EvalEnv, Player
from megastep.agents.factory import components, env_failures, settings
from megastep.agents.factory import make as factory
from megastep.agents.runs import checkpoint, folders, restore
from megastep.agents.types import Row
from megastep.types import optional

ORACLE = "oracle"  # the bot that knows where everything is
#: Number of orders that ratings are averaged over.
N_ORDERS = 10

#: Scores of player i in duels with player j, by (i, j): 1 won, 0 lost, 0.5 a draw.
Scores = Mapping[tuple[int, int], Sequence[float]]

#: Columns of the table, and the forms of their numbers.
COLUMNS = dict(player="", rating=".2f", sigma=".2f", won=".3f", duels="")


def run(cfg: settings.Evaluate) -> Path:
    """Evaluates a run, each environment in one home throughout. Returns the path of the table: of
    .json, .md and .csv files in the run's folder `evaluations`. With several ranks, each plays some
    of the environments, and rank 0 writes.
    """
    start, device = time.monotonic(), factory.make_device(cfg.device)
    loaded = folders.load_checkpoint(folders.find(cfg.run), cfg.trust, device)
    options: dict = dict(episodes=cfg.episodes, seed=cfg.seed, device=device)
    options["is_duel"] = cfg.ratings or cfg.against is not None
    if options["is_duel"]:
        eval_env.check_duels_of(cfg.env or factory.config_of(loaded).env, device)
    env_settings, geometry, homes = factory.played_in(cfg, loaded)
    with env_failures.caught(env_settings, folders.folder_of(loaded.path)):
        if cfg.ratings:
            where = EvalEnv(env_settings, homes, **options)
            path = write_ratings(cfg, loaded, where, geometry)
        else:
            path = _measure(cfg, loaded, env_settings, geometry, homes, options)
    console.say(f"Evaluated in {console.duration(time.monotonic() - start)}")
    return path


def _measure(cfg, loaded, env_settings, geometry, homes, options) -> Path:
    rows, differences, episodes = [], [], []
    numbers = {id(home): number for number, home in enumerate(homes)}
    for source, part in tables.parts_of(geometry, homes):
        where = EvalEnv(env_settings, part, **options)
        play = _play if cfg.against is None else _duel
        of_part = play(cfg, loaded, where, source, [numbers[id(home)] for home in where.homes])
        for one, found in zip((rows, differences), of_part, strict=False):
            one += [row | ({"source": source} if source else {}) for row in found]
        episodes += of_part[2]
        if process_group.rank() == 0:
            where.warn_without_layout()
    if process_group.rank() > 0:
        return folders.folder_of(loaded.path)
    is_duel, is_suite = cfg.against is not None, geometry.name == components.SUITE
    who = "against" if is_duel else "agent"
    order = [*dict.fromkeys(row[who] for row in rows)]
    rows.sort(key=lambda row: order.index(row[who]))  # all sources of one after the other
    n_homes = {row.get("source"): row["homes"] or 0 for row in reversed(rows)}
    n_homes = n_homes.get(None) or sum(n_homes.values())
    what = f"{rows[0]['duels']:,} duels" if is_duel else f"{rows[0]['lanes']:,} episodes"
    what += " in each source" * is_suite
    title = tables.title_of(where, geometry, cfg.split, what, n_homes)
    names = [tables.source_of(where, geometry), "env" * (cfg.env is not None), cfg.split]
    if cfg.against is not None:
        names = ["duels", names[0], cfg.split, str(loaded.step), "against", *cfg.against]
        title = f"{eval_env.name_of(loaded)}, in {title}, seed {cfg.seed}"
    else:
        names.append(str(loaded.step))
        title += f", after {loaded.step:,} samples ({loaded.path.name}), seed {cfg.seed}"
    return tables.write_table(cfg, loaded, names, title, rows, differences, episodes)


def _duel(cfg, loaded, where, source, _) -> tuple[list[Row], list[Row], list[Row]]:
    """Plays the run's agent against each of `cfg.against`. Returns the rows of the table."""
    agent, rows = eval_env.load_player(loaded, where.sample, loaded), []
    for opponent in where.players(cfg.against, loaded, cfg.trust):
        played = where.duel(cfg, loaded, agent, opponent)
        rows += [{"against": opponent.name, **row} for row in _rows(where, played, source)]
    return rows, [], []


def _play(
    cfg: settings.Evaluate,
    loaded: checkpoint.Checkpoint,
    where: EvalEnv,
    source: str | None,
    numbers: list[int],
) -> tuple[list[Row], list[Row], list[Row]]:
    """Plays `cfg.episodes` with the run's agent and each of `cfg.baseline`, all from the same
    places with the same draws, in homes of a `source` or of several, which have `numbers`. Returns
    the rows of the table, those of the agent less each other, and those of the episodes. With the
    bot `oracle`, `oracle_fraction` is what each found divided by what that one found.
    """
    policy = restore.policy_of(loaded, where.env)
    players = [Player("trained, greedy" if cfg.greedy else "trained", policy, loaded)]
    players += where.players(cfg.baseline, loaded, cfg.trust)
    played = {}
    for player in players:
        (policy,) = where.begin(loaded, player)
        greedy = cfg.greedy and player.loaded is not None
        one = playing.first_episodes(where.env, policy, where.seed, greedy, cfg.max_steps)
        played[player.name] = where.shard.with_others(one)
    if ORACLE in played:
        found = played[ORACLE]["metrics"]["found"]
        for one in played.values():
            one["metrics"]["oracle_fraction"] = one["metrics"]["found"] / found.clamp(min=1)
    rows, differences, episodes = [], [], []
    roles, sources = optional(where.env, "roles"), factory.sources_of(where.homes)
    (own_name, own), *_ = played.items()
    for name, one in played.items():
        n_cut = int((~one["done"]).sum())
        if n_cut and process_group.rank() == 0:
            limit = cfg.max_steps or optional(where.env, "max_episode_steps")
            console.warn(
                f"{name}: {n_cut:,} of {len(one['done']):,} episodes had not ended after "
                f"{limit:,} steps and are counted as truncated there; max_steps= sets the limit"
            )
        rows += [{"agent": name, **row} for row in _rows(where, one, source)]
        if one is not own:
            less = statistics.difference(own, one)
            found = _rows(where, less, None if source is None else "")
            differences += [{"agent": f"{own_name} - {name}", **row} for row in found]
        each = statistics.rows_of(one, cfg.seed, numbers, sources, roles)
        episodes += [{"agent": name, **row} for row in each]
    return rows, differences, episodes


def _rows(where, played, source) -> list[Row]:
    sources = factory.sources_of(where.homes) if source is None else None
    return statistics.summaries(played, optional(where.env, "roles"), sources)


# ---- Ratings of players from the results of their duels ----


def write_ratings(
    cfg: settings.Evaluate, run: checkpoint.Checkpoint, where: EvalEnv, geometry: settings.Geometry
) -> Path:
    """Rates a run's snapshots, and others, by duels of each with each; writes ratings.csv.

    A rating of openskill, by the Plackett-Luce model of Weng and Lin (JMLR 12, 2011), is a mean,
    which starts at 25, and a standard deviation. Rated 5.9 higher, a player wins 73 % of duels.
    """
    folder, players = folders.folder_of(run.path), []
    for path in (
        checkpoint.list_checkpoints(folder / "snapshots")
        or checkpoint.list_checkpoints(folder / "checkpoints")
        or [run.path]  # the file of an agent
    ):
        try:
            (player,) = where.players([str(path)], run, cfg.trust)
        except UserError:
            if path.exists():
                raise
            continue  # its run, which is training, has deleted it
        players.append(player._replace(name=f"{player.step:,} samples"))
    players += where.players(cfg.against or (), run, cfg.trust)
    if len(players) < 2:
        raise UserError(
            f"{folder} has one checkpoint and nothing to compare it with: train with "
            "checkpoints.snapshots=8, or name others with against="
        )
    where.warn_without_layout()
    pairs = [*itertools.combinations(range(len(players)), 2)]
    played = {(i, j): where.duel(cfg, run, players[i], players[j]) for i, j in pairs}
    if process_group.rank() > 0:
        return folder
    scores = {pair: one["score"].tolist() for pair, one in played.items()}
    table = []
    for k, (mean, sigma) in enumerate(rate(len(players), scores, cfg.seed)):
        results = [score for (i, _), values in scores.items() if i == k for score in values]
        results += [1 - score for (_, j), values in scores.items() if j == k for score in values]
        about = dict(player=players[k].name, samples=players[k].step, rating=mean, sigma=sigma)
        table.append(about | dict(won=sum(results) / len(results), duels=len(results)))
    layouts, what = played[0, 1].get("homes"), f"{where.shard.n_envs:,} duels of each pair"
    n_homes = None if layouts is None else len(layouts.unique())
    title = tables.title_of(where, geometry, cfg.split, what, n_homes)
    title = f"Ratings in {title}, seed {cfg.seed}"
    cells = [[format(row[name], form) for name, form in COLUMNS.items()] for row in table]
    console.say(f"{title}\n{console.table([*COLUMNS], cells)}")
    rows = [[*row.values()] for row in table]
    folders.write({folder / "ratings.csv": console.as_csv([*table[0]], rows)})
    return folder / "ratings.csv"


def rate(n_players: int, scores: Scores, seed: int = 1) -> list[tuple[float, float]]:
    """Returns (mean, standard deviation) of each player's rating, over random orders of duels."""
    from openskill.models import PlackettLuce

    duels = [(i, j, score) for (i, j), values in scores.items() for score in values]
    generator, model = np.random.default_rng(seed), PlackettLuce(tau=0.0)  # strengths do not drift
    ratings = []
    for _ in range(N_ORDERS):
        players = [model.rating() for _ in range(n_players)]
        for k in generator.permutation(len(duels)):
            i, j, score = duels[k]
            [players[i]], [players[j]] = model.rate(
                [[players[i]], [players[j]]], scores=[score, 1 - score]
            )
        ratings.append([(player.mu, player.sigma) for player in players])
    return [(float(mean), float(sigma)) for mean, sigma in np.mean(ratings, 0)]
