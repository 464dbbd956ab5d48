"""Measures a trained policy on unseen homes, or against others in duels."""

import copy
import time
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents import console, factory
from megastep.agents.distributed import process_group
from megastep.agents.evaluation import arena, episodes, playing, replay, statistics, suite, tables
from megastep.agents.factory import env_failures, settings
from megastep.agents.runs import checkpoint, folders
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

    Writes .json, .md, .csv, which has a row per episode, and .npz, from which `record.py worst=3`
    plays episodes again, into the run's folder `evaluations`, one of each per source of geometries
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
        rows, single, actions = [], [], []
        numbers = {id(home): number for number, home in enumerate(homes)}
        for source, part in suite.parts_of(geometry, homes):
            table, each, taken = play(cfg, loaded, env_settings, part, device, source)
            actions.append(taken)
            rows += suite.of_source(source, table)
            if source:  # the number among all homes, not among those of the source
                where = [numbers[id(home)] for home in part]
                each = [
                    row | {"home": where[row["home"]]} if "home" in row else row for row in each
                ]
            single += each
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
            single,
            replay.as_bytes(actions),
        )
    return path


def play(
    cfg: settings.Evaluate,
    loaded: checkpoint.Checkpoint,
    env_settings: settings.Env,
    homes: list,
    device: "torch.device",
    source: str | None = None,
) -> "tuple[list[Row], list[Row], playing.Actions | None]":
    """Plays `cfg.episodes` in homes, in all of a `source` or of several. Returns the rows of the
    table, those of the episodes, and the actions of the run's agent.
    """
    stage = arena.Stage(env_settings, homes, cfg.episodes, cfg.seed, device)
    env, roles = stage.env, optional(stage.env, "roles")
    sources = factory.sources_of(stage.homes)
    rows, single, recorder = [], [], playing.Recorder()
    players = players_of(cfg, loaded, stage)
    all_played = play_all(stage, players, cfg.max_steps, recorder)
    for (player, _), played in zip(players, all_played, strict=True):
        n_cut = int((~played["done"]).sum())
        if n_cut and process_group.rank() == 0:
            limit = cfg.max_steps or optional(env, "max_episode_steps")
            console.warn(
                f"{player.name}: {n_cut:,} of {len(played['done']):,} episodes had not ended after "
                f"{limit:,} steps and are counted as truncated there; max_steps= sets the limit"
            )
        summaries = statistics.summaries(played, roles, None if source else sources)
        if source == suite.DENSE and "homes" in played:
            summaries.append({"tail": statistics.TAIL, **statistics.worst_summary(played)})
        rows += [{"agent": player.name, **row} for row in summaries]
        each = episodes.rows_of(played, cfg.seed, stage.numbers, sources, roles)
        single += [{"agent": player.name, **row} for row in each]
    if process_group.rank() == 0:
        arena.warn_without_layout(env, stage.homes)
    return rows, single, stage.actions(recorder)


def play_all(
    stage: arena.Stage,
    players: list[tuple[arena.Player, bool]],
    max_steps: int | None,
    recorder: playing.Recorder,
) -> "list[arrdict]":
    """Returns the first episodes of each player, see `playing.first_episodes`.

    If the bot `oracle` is among them, all play the same episodes, and have a further metric,
    `oracle_fraction`: what they found divided by what the oracle found in the same episode.

    Args:
        recorder: of the first player, as the environment's generators are where its seed puts them.
    """
    names = [player.name for player, _ in players]
    has_oracle = ORACLE in names
    # a copy, as the state's tensors are the environment's own
    state = EnvState(stage.env) if has_oracle else None
    first = copy.deepcopy(state.state_dict()) if state is not None else {}
    all_played = []
    for number, (player, greedy) in enumerate(players):
        if state is not None:
            state.load_state_dict(first)
        own = None if number else recorder
        all_played.append(stage.play(player.policy, greedy, max_steps, own))
    if has_oracle:
        found = all_played[names.index(ORACLE)]["metrics"]["found"]
        for played in all_played:
            played["metrics"]["oracle_fraction"] = played["metrics"]["found"] / found.clamp(min=1)
    return all_played


def players_of(
    cfg: settings.Evaluate, loaded: checkpoint.Checkpoint, stage: arena.Stage
) -> list[tuple[arena.Player, bool]]:
    """Returns who plays, the run's agent and each of `cfg.baseline`, and whether it is greedy."""
    policy = factory.make_policy(factory.config_of(loaded).agent, stage.env)
    policy = factory.load_weights(policy, stage.env, loaded)
    factory.load_wrappers(stage.env, loaded)
    players = [(arena.Player("trained, greedy" if cfg.greedy else "trained", policy), cfg.greedy)]
    for name in cfg.baseline:
        player = arena.find_player(name, loaded, stage.settings, stage.sample, cfg.trust)
        own = factory.in_env(player.policy, stage.settings, stage.env)
        players.append((player._replace(policy=own), cfg.greedy and player.step is not None))
    return players


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
