"""Measures a trained policy on unseen homes, or against others in duels."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents import console, factory
from megastep.agents.distributed import process_group
from megastep.agents.distributed.shard import Shard
from megastep.agents.evaluation import arena, playing, statistics, suite, tables
from megastep.agents.factory import env_failures, settings
from megastep.agents.generator import rank_seed
from megastep.agents.runs import checkpoint, folders
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.types import optional

if TYPE_CHECKING:
    import torch


def run(cfg: settings.Evaluate) -> Path:
    """Evaluates a run, each environment in one home throughout. Returns the path of the table.

    Of several ranks, each plays its share. Rank 0 writes; the others return the run's folder.

    Writes .json and .md into the run's folder `evaluations`, one of each per source of geometries
    (per environment where it has none), split and checkpoint. Of `geometry=suite` plays as many
    episodes in each source, and adds the worst source and the worst dense homes. With `cfg.against`
    plays duels instead; with `cfg.ratings` writes ratings.csv and ratings.svg.
    """
    start, device = time.monotonic(), factory.make_device(cfg.device, process_group.local_rank())
    loaded = folders.load_checkpoint(folders.find(cfg.run), cfg.trust, device)
    trained = factory.config_of(loaded)
    env_settings = cfg.env or trained.env
    geometry = factory.typed_or(trained.geometry, cfg.geometry, env_settings)
    homes = factory.homes(env_settings, geometry, cfg.split)
    folder, rank = folders.folder_of(loaded.path), process_group.rank()
    with env_failures.told(env_settings, folder, rank=rank):
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
    """Does what `run` does, with what its settings name."""
    if cfg.ratings:
        path = arena.Arena(cfg, loaded, env_settings, geometry, homes, device).rate()
    elif cfg.against is not None:
        path = duel(cfg, loaded, env_settings, geometry, homes, device)
    else:
        rows = []
        for source, part in suite.parts_of(geometry, homes):
            rows += suite.of_source(source, play(cfg, loaded, env_settings, part, device, source))
        if process_group.rank() > 0:
            return folders.folder_of(loaded.path)
        labels = tables.labels(env_settings, geometry, homes, cfg.split)
        what = f"{rows[0]['lanes']:,} episodes{suite.each_source(geometry)}"
        n_homes = suite.count_homes(rows)
        rows = suite.with_worst_source(rows, "agent") if suite.is_suite(geometry) else rows
        path = tables.write_table(
            cfg,
            loaded,
            [labels.source, "env" if cfg.env else "", cfg.split, str(loaded.step)],
            f"{labels.title(what, n_homes)}, after {loaded.step:,} samples "
            f"({loaded.path.name}), seed {cfg.seed}",
            rows,
            [*map(tables.cells, rows)],
        )
    return path


def play(
    cfg: settings.Evaluate,
    loaded: checkpoint.Checkpoint,
    env_settings: settings.Env,
    homes: list,
    device: "torch.device",
    source: str | None = None,
) -> list[dict]:
    """Plays `cfg.episodes` in homes, in all of a `source` or of several. Returns the table rows."""
    seed, trained = rank_seed(cfg.seed, process_group.rank()), factory.config_of(loaded)
    sample = factory.make_sample(env_settings, homes, seed=seed, device=device)
    n_envs = -(-cfg.episodes // optional(sample, "n_agents"))
    homes = factory.spread(homes, n_envs)
    shard = Shard.of_this_rank(n_envs, len(homes))
    env_settings = settings.changed(env_settings, n_envs=len(shard.envs), resample=False)
    where = dict(geometries=[homes[home] for home in shard.homes], seed=seed, device=device)
    env, rows = factory.construct(env_settings, **where), []
    policy = factory.load_weights(factory.make_policy(trained.agent, env), env, loaded)
    factory.load_wrappers(env, loaded)
    players = [("trained, greedy" if cfg.greedy else "trained", policy, cfg.greedy)]
    players += [("random", RandomActions(env.action_space), False)] * cfg.baseline
    sources = None if source else factory.sources_of(homes)
    for name, player, greedy in players:
        played = playing.first_episodes(env, player, seed, greedy, cfg.max_steps)
        episodes = shard.with_others(played)
        n_cut = int((~episodes["done"]).sum())
        if n_cut and process_group.rank() == 0:
            limit = cfg.max_steps or optional(env, "max_episode_steps")
            console.warn(
                f"{name}: {n_cut:,} of {len(episodes['done']):,} episodes had not ended after "
                f"{limit:,} steps and are counted as truncated there; max_steps= sets the limit"
            )
        summaries = statistics.summaries(episodes, optional(env, "roles"), sources)
        if source == suite.DENSE and "homes" in episodes:
            summaries.append({"tail": statistics.TAIL, **statistics.worst_summary(episodes)})
        rows += [{"agent": name, **row} for row in summaries]
    if process_group.rank() == 0:
        arena.warn_without_layout(env, homes)
    return rows


def duel(
    cfg: settings.Evaluate,
    run: checkpoint.Checkpoint,
    env: settings.Env,
    geometry: settings.Geometry,
    homes: list,
    device: "torch.device",
) -> Path:
    """Plays the run's agent against each of `cfg.against`, of a suite in each source. Prints and
    writes a table, and returns the path of its .json.
    """
    rows = []
    for source, part in suite.parts_of(geometry, homes):
        meeting = arena.Arena(cfg, run, env, geometry, part, device)
        rows += suite.of_source(source, meeting.duel(source))
    if process_group.rank() > 0:
        return folders.folder_of(run.path)
    labels = tables.labels(meeting.env_settings, geometry, homes, cfg.split)
    what = f"{rows[0]['duels']:,} duels{suite.each_source(geometry)}"
    title = labels.title(what, suite.count_homes(rows))
    rows = suite.with_worst_source(rows, "against") if suite.is_suite(geometry) else rows
    return tables.write_table(
        cfg,
        run,
        ["duels", labels.source, cfg.split, str(run.step), "against", *(cfg.against or ())],
        f"{meeting.agent.name}, in {title}, seed {cfg.seed}",
        rows,
        [*map(tables.duel_cells, rows)],
    )
