"""Measures a trained policy on unseen homes, or against others in duels."""

import copy
import time
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents import console, factory
from megastep.agents.distributed import process_group
from megastep.agents.evaluation import playing, ratings, statistics, tables
from megastep.agents.evaluation.duels import Duels
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.factory import env_failures, settings
from megastep.agents.runs import checkpoint, folders, restore
from megastep.env_state import EnvState
from megastep.types import optional

if TYPE_CHECKING:
    from megastep.agents.types import Row

ORACLE = "oracle"  # the bot that knows where everything is


def run(cfg: settings.Evaluate) -> Path:
    """Evaluates a run, each environment in one home throughout. Returns the path of the table.

    With several ranks, each plays some of the environments. Rank 0 writes; the others return the
    run's folder.

    Writes .json, .md and .csv, which has a row per episode, into the run's folder `evaluations`,
    one of each per source of geometries (per environment where it has none), split and checkpoint.
    Of `geometry=suite` plays as many episodes in each source, and adds the worst source and the
    worst dense homes. With `cfg.against` plays duels; with `cfg.ratings` writes ratings.csv.
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
            path = _measure(cfg, loaded, env_settings, geometry, homes, device)
    console.say(f"Evaluated in {console.duration(time.monotonic() - start)}")
    return path


def _measure(cfg, loaded, env_settings, geometry, homes, device) -> Path:
    rows, single = [], []
    numbers = {id(home): number for number, home in enumerate(homes)}
    for source, part in tables.parts_of(geometry, homes):
        if cfg.against is not None:
            duels = Duels(cfg, loaded, env_settings, part, device)
            where, of_part = duels.where, duels.rows(source)
        else:
            where = EvalEnv(env_settings, part, cfg.episodes, cfg.seed, device)
            of_part, each = play(cfg, loaded, where, source)
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
    names = [labels.source, "env" if cfg.env else "", cfg.split, str(loaded.step)]
    if cfg.against is not None:
        names = ["duels", labels.source, cfg.split, str(loaded.step), "against", *cfg.against]
        title = f"{duels.agent.name}, in {title}, seed {cfg.seed}"
    else:
        title += f", after {loaded.step:,} samples ({loaded.path.name}), seed {cfg.seed}"
    return tables.write_table(cfg, loaded, names, title, rows, single)


def play(
    cfg: settings.Evaluate, loaded: checkpoint.Checkpoint, where: EvalEnv, source: str | None
) -> "tuple[list[Row], list[Row]]":
    """Plays `cfg.episodes` with the run's agent and each of `cfg.baseline`, in homes of a `source`
    or of several. Returns the rows of the table, and those of the episodes.

    If the bot `oracle` is among them, all play the same episodes, and have a further metric,
    `oracle_fraction`: what they found divided by what the oracle found in the same episode.
    """
    env, policy = where.env, restore.policy_of(loaded, where.env)
    restore.load_wrappers(env, loaded)
    all_play: list = [("trained, greedy" if cfg.greedy else "trained", policy, cfg.greedy)]
    for name in cfg.baseline:
        player = where.find_player(name, loaded, cfg.trust)
        all_play.append((player.name, player.policy, cfg.greedy and player.step is not None))
    names = [name for name, *_ in all_play]
    state = EnvState(env) if ORACLE in names else None
    # a copy, as the state's tensors are the environment's own
    first = {} if state is None else copy.deepcopy(state.state_dict())
    all_played = []
    for _, policy, greedy in all_play:
        if state is not None:
            state.load_state_dict(first)
        played = playing.first_episodes(env, policy, where.seed, greedy, cfg.max_steps)
        all_played.append(where.shard.with_others(played))
    if state is not None:
        found = all_played[names.index(ORACLE)]["metrics"]["found"]
        for played in all_played:
            played["metrics"]["oracle_fraction"] = played["metrics"]["found"] / found.clamp(min=1)
    roles, sources, rows, single = optional(env, "roles"), factory.sources_of(where.homes), [], []
    is_first = process_group.rank() == 0
    for name, played in zip(names, all_played, strict=True):
        n_cut = int((~played["done"]).sum())
        if n_cut and is_first:
            limit = cfg.max_steps or optional(env, "max_episode_steps")
            console.warn(
                f"{name}: {n_cut:,} of {len(played['done']):,} episodes had not ended after "
                f"{limit:,} steps and are counted as truncated there; max_steps= sets the limit"
            )
        summaries = statistics.summaries(played, roles, None if source else sources)
        if source == tables.DENSE and "homes" in played:
            summaries.append({"tail": statistics.TAIL, **statistics.worst_summary(played)})
        rows += [{"agent": name, **row} for row in summaries]
        each = statistics.rows_of(played, cfg.seed, where.numbers, sources, roles)
        single += [{"agent": name, **row} for row in each]
    if is_first:
        where.warn_without_layout()
    return rows, single
