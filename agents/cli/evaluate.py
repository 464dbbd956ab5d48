"""Measures a trained policy on unseen homes. `evaluate --help`; `run(cfg)` is the same
from Python.
"""

import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from megastep.agents.cli import arena, factory, run_folders, tables
from megastep.agents.cli.arena import source
from megastep.agents.cli.command import Script, run_command
from megastep.agents.cli.console import duration, say, table
from megastep.agents.cli.registry import label
from megastep.agents.cli.settings import Evaluate
from megastep.agents.cli.tables import INTERVAL
from megastep.agents.training import evaluation

HELP = """Prints and writes what a run's agent earns in the first episode of each lane, with a 95 %
interval over homes. Each table is a file of its own in the run's folder: evaluations/*.md.

The commonest:
  run=RUN              a run folder, one of its checkpoints, or latest
  split=training       the homes it was trained in, instead of unseen ones
  geometry=bench       other homes altogether
  env=pong             another environment of the same spaces: the tracker, after self-play
  greedy=true          the likeliest actions instead of sampled ones
  episodes=256            fewer episodes
  baseline=false       no row for random actions
  against=RUN,bot      duels instead: with other runs or checkpoints, the scripted policy, random
                       actions, or an import path
  ratings=true         ratings of the run's snapshots, by duels of each with each"""


def run(cfg: Evaluate) -> Path:
    """Evaluates as `cfg` says, each environment in one home throughout. Writes the table to the
    run's folder `evaluations`, one .json and .md per geometry source (the environment's name if it
    has none), split and checkpoint; returns the path of the .json. With `against` or `ratings`, it
    is `arena` that does.
    """
    if cfg.ratings:
        return arena.rate(cfg)
    if cfg.against is not None:
        return arena.run(cfg)
    device, path = factory.make_device(cfg.device), run_folders.find(cfg.run)
    loaded = factory.load_checkpoint(path, device)
    trained = factory.config_of(loaded)
    chosen, geometry = cfg.env or trained.env, cfg.geometry or trained.geometry
    homes = factory.homes(chosen, geometry, cfg.split, cfg.episodes)
    env = factory.make_env(settled(chosen, cfg.episodes), homes, cfg.seed, device)
    policy = factory.make_actor(trained.agent, env)
    factory.load_weights(policy, env, loaded)
    players = {"trained, greedy" if cfg.greedy else "trained": policy}
    if cfg.baseline:
        players["random"] = evaluation.RandomActions(env.action_space)

    start, rows = time.monotonic(), []
    for name, player in players.items():
        episodes = evaluation.first_episodes(env, player, cfg.seed, cfg.greedy and player is policy)
        roles = getattr(env, "roles", None)
        rows += [{"agent": name, **row} for row in evaluation.summaries(episodes, roles)]
    which = "all" if cfg.split == "all" else f"the {cfg.split}"
    where, name = label(chosen.name), label(chosen.name)
    if homes:
        where, name = f"{where} in {which} homes of {source(geometry)}", source(geometry)
    title = (
        f"{where}, after {loaded.step:,} samples ({loaded.path.name}), seed {cfg.seed}, "
        f"{env.n_envs * env.n_agents:,} lanes"
    )
    say(title)
    head, lines = columns(rows), [cells(row) for row in rows]
    say(table(head, lines))
    say(f"evaluated in {duration(time.monotonic() - start)}")
    other = "-env" if cfg.env else ""
    name = f"{name}{other}-{cfg.split}-{loaded.step}{'-greedy' if cfg.greedy else ''}"
    result = dict(
        title=title,
        checkpoint=str(loaded.path),
        step=loaded.step,
        evaluation=dataclasses.asdict(cfg),
        rows=rows,
    )
    return tables.write(run_folders.folder_of(path) / "evaluations", name, result, head, lines)


def settled(env: Any, n_envs: int) -> Any:
    """An environment's settings for `n_envs` environments that stay in the homes they start in."""
    moving = {"resample": False} if hasattr(env, "resample") else {}
    return dataclasses.replace(env, n_envs=n_envs, **moving)


def columns(rows: Sequence[dict]) -> tuple[str, ...]:
    """The head of the table: each metric and its interval beside the return's."""
    metrics = [word for name in (rows[0]["metrics"] if rows else ()) for word in (name, INTERVAL)]
    return "agent", "return", INTERVAL, *metrics, "length", "episodes", "homes"


def cells(row: dict) -> tuple[str, ...]:
    """A row of the table, as text."""
    cut = f", {row['unfinished']} cut short" if row["unfinished"] else ""
    metrics = [word for metric in row["metrics"].values() for word in metric_cells(**metric)]
    return (
        f"{row['agent']}: {row['role']}" if "role" in row else row["agent"],
        f"{row['return']:.2f}",
        f"{row['lower']:.2f} to {row['upper']:.2f}",
        *metrics,
        f"{row['length']:.0f}",
        f"{row['lanes']}{cut}",
        "none" if row["homes"] is None else str(row["homes"]),
    )


def metric_cells(mean: float | None, lower: float | None, upper: float | None) -> tuple[str, str]:
    """A metric and its interval, as text."""
    return ("none", "none") if mean is None else (f"{mean:.3g}", f"{lower:.3g} to {upper:.3g}")


def main(argv: list[str] | None = None) -> int:
    words = sys.argv[1:] if argv is None else argv
    words = [arena.listed(word) if word.startswith("against=") else word for word in words]
    return run_command(Script("evaluate", Evaluate, run, HELP), words)
