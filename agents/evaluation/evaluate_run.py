"""Measures a trained policy on unseen homes, or against others in duels."""

import time
from pathlib import Path

from megastep.agents import console
from megastep.agents.distributed import process_group
from megastep.agents.evaluation import eval_env, playing, ratings, statistics, tables
from megastep.agents.evaluation.eval_env import EvalEnv, Player
from megastep.agents.factory import components, env_failures, settings
from megastep.agents.factory import make as factory
from megastep.agents.runs import checkpoint, folders, restore
from megastep.agents.types import Row
from megastep.types import optional

ORACLE = "oracle"  # the bot that knows where everything is


def run(cfg: settings.Evaluate) -> Path:
    """Evaluates a run, each environment in one home throughout. Returns the path of the table: of
    .json, .md and .csv files in the run's folder `evaluations`. With several ranks, each plays some
    of the environments, and rank 0 writes.
    """
    start, device = time.monotonic(), factory.make_device(cfg.device)
    loaded = folders.load_checkpoint(folders.find(cfg.run), cfg.trust, device)
    env_settings, geometry, homes = factory.played_in(cfg, loaded)
    folder, rank = folders.folder_of(loaded.path), process_group.rank()
    options: dict = dict(episodes=cfg.episodes, seed=cfg.seed, device=device)
    options["is_duel"] = cfg.ratings or cfg.against is not None
    with env_failures.caught(env_settings, folder, rank=rank):
        if cfg.ratings:
            where = EvalEnv(env_settings, homes, **options)
            path = ratings.write(cfg, loaded, where, geometry)
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
