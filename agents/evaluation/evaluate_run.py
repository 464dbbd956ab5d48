"""Measures a trained policy on unseen homes, or against others in duels."""

import copy
import time
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents import console, factory
from megastep.agents.distributed import process_group
from megastep.agents.evaluation import players, playing, ratings, statistics, tables
from megastep.agents.evaluation.duels import Duels
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.factory import env_failures, settings
from megastep.agents.runs import checkpoint, folders, restore
from megastep.env_state import EnvState
from megastep.types import optional

if TYPE_CHECKING:
    import torch

    from megastep.agents.types import Row
    from megastep.arrdict import arrdict

ORACLE = "oracle"  # the bot that knows where everything is


def run(cfg: settings.Evaluate) -> Path:
    """Evaluates a run, each environment in one home throughout. Returns the path of the table.

    With several ranks, each plays some of the environments. Rank 0 writes; the others return the
    run's folder.

    Writes .json, .md and .csv, which has a row per episode, into the run's folder `evaluations`,
    one of each per source of geometries (per environment where it has none), split and checkpoint.
    Of `geometry=suite` plays as many episodes in each source, and adds the worst source and the
    worst dense homes. With `cfg.against` plays duels instead; with `cfg.ratings` writes ratings.csv
    and ratings.svg.
    """
    start, device = time.monotonic(), factory.make_device(cfg.device, process_group.local_rank())
    loaded = folders.load_checkpoint(folders.find(cfg.run), cfg.trust, device)
    trained = factory.config_of(loaded)
    env_settings = cfg.env or trained.env
    geometry = factory.typed_or(trained.geometry, cfg.geometry, env_settings)
    homes = factory.homes(env_settings, geometry, cfg.split)
    folder, rank = folders.folder_of(loaded.path), process_group.rank()
    with env_failures.caught(env_settings, folder, rank=rank):
        if cfg.ratings:
            duels = Duels(cfg, loaded, env_settings, homes, device)
            path = ratings.write(duels, tables.labels(duels.where, geometry, cfg.split))
        else:
            path = measure(cfg, loaded, env_settings, geometry, homes, device)
    console.say(f"Evaluated in {console.duration(time.monotonic() - start)}")
    return path


def measure(
    cfg: settings.Evaluate,
    loaded: checkpoint.Checkpoint,
    env_settings: settings.Env,
    geometry: settings.Geometry,
    homes: list,
    device: "torch.device",
) -> Path:
    """Plays episodes, or with `cfg.against` duels, of a suite in each source. Prints and writes a
    table, and returns the path of its .json.
    """
    rows, single = [], []
    numbers = {id(home): number for number, home in enumerate(homes)}
    for source, part in tables.parts_of(geometry, homes):
        if cfg.against is not None:
            duels = Duels(cfg, loaded, env_settings, part, device)
            where, of_part = duels.where, duels.rows(source)
        else:
            where, of_part, each = play(cfg, loaded, env_settings, part, device, source)
            if source:  # the number among all homes, not among those of the source
                for row in each:
                    if "home" in row:
                        row["home"] = numbers[id(part[row["home"]])]
            single += each
        rows += [row | ({"source": source} if source else {}) for row in of_part]
    if process_group.rank() > 0:
        return folders.folder_of(loaded.path)
    labels = tables.labels(where, geometry, cfg.split)
    title, rows = tables.title_of(labels, geometry, rows, "duels" if cfg.against else "lanes")
    if cfg.against is not None:
        names = ["duels", labels.source, cfg.split, str(loaded.step), "against", *cfg.against]
        title, cells = f"{duels.agent.name}, in {title}, seed {cfg.seed}", tables.duel_cells
    else:
        names = [labels.source, "env" if cfg.env else "", cfg.split, str(loaded.step)]
        title += f", after {loaded.step:,} samples ({loaded.path.name}), seed {cfg.seed}"
        cells = tables.cells
    n_ranks = where.shard.n_ranks
    return tables.write_table(cfg, loaded, names, title, rows, [*map(cells, rows)], single, n_ranks)


def play(
    cfg: settings.Evaluate,
    loaded: checkpoint.Checkpoint,
    env_settings: settings.Env,
    homes: list,
    device: "torch.device",
    source: str | None = None,
) -> "tuple[EvalEnv, list[Row], list[Row]]":
    """Plays `cfg.episodes` in homes, in all of a `source` or of several. Returns where, the rows of
    the table, and those of the episodes.
    """
    where = EvalEnv(env_settings, homes, cfg.episodes, cfg.seed, device)
    env, roles, sources = where.env, optional(where.env, "roles"), factory.sources_of(where.homes)
    rows, single, is_first = [], [], process_group.rank() == 0
    playing_ones = players_of(cfg, loaded, where)
    for (player, _), played in zip(playing_ones, play_all(cfg, where, playing_ones), strict=True):
        n_cut = int((~played["done"]).sum())
        if n_cut and is_first:
            limit = cfg.max_steps or optional(env, "max_episode_steps")
            console.warn(
                f"{player.name}: {n_cut:,} of {len(played['done']):,} episodes had not ended after "
                f"{limit:,} steps and are counted as truncated there; max_steps= sets the limit"
            )
        summaries = statistics.summaries(played, roles, None if source else sources)
        if source == tables.DENSE and "homes" in played:
            summaries.append({"tail": statistics.TAIL, **statistics.worst_summary(played)})
        rows += [{"agent": player.name, **row} for row in summaries]
        each = statistics.rows_of(played, cfg.seed, where.numbers, sources, roles)
        single += [{"agent": player.name, **row} for row in each]
    if is_first:
        where.warn_without_layout()
    return where, rows, single


def play_all(
    cfg: settings.Evaluate, where: EvalEnv, playing_ones: list[tuple[players.Player, bool]]
) -> "list[arrdict]":
    """Returns the first episodes of each player on all ranks, see `playing.first_episodes`.

    If the bot `oracle` is among them, all play the same episodes, and have a further metric,
    `oracle_fraction`: what they found divided by what the oracle found in the same episode.
    """
    names = [player.name for player, _ in playing_ones]
    has_oracle = ORACLE in names
    # a copy, as the state's tensors are the environment's own
    state = EnvState(where.env) if has_oracle else None
    first = copy.deepcopy(state.state_dict()) if state is not None else {}
    all_played = []
    for player, greedy in playing_ones:
        if state is not None:
            state.load_state_dict(first)
        settings_of = where.env, player.policy, where.seed, greedy, cfg.max_steps
        all_played.append(where.shard.with_others(playing.first_episodes(*settings_of)))
    if has_oracle:
        found = all_played[names.index(ORACLE)]["metrics"]["found"]
        for played in all_played:
            played["metrics"]["oracle_fraction"] = played["metrics"]["found"] / found.clamp(min=1)
    return all_played


def players_of(
    cfg: settings.Evaluate, loaded: checkpoint.Checkpoint, where: EvalEnv
) -> list[tuple[players.Player, bool]]:
    """Returns who plays, the run's agent and each of `cfg.baseline`, and whether it is greedy."""
    policy = restore.policy_of(loaded, where.env)
    restore.load_wrappers(where.env, loaded)
    every = [(players.Player("trained, greedy" if cfg.greedy else "trained", policy), cfg.greedy)]
    for name in cfg.baseline:
        player = players.find_player(name, loaded, where.settings, where.sample, cfg.trust)
        own = factory.in_env(player.policy, where.settings, where.env)
        every.append((player._replace(policy=own), cfg.greedy and player.step is not None))
    return every
