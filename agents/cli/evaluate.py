"""Measures a trained policy on unseen homes. `evaluate --help`; `run(cfg)` is the same from Python."""

import re
import sys
import time
from pathlib import Path

from megastep.agents.cli import duels, factory, runs
from megastep.agents.cli.command import run_command
from megastep.agents.cli.compose import Script
from megastep.agents.cli.console import duration, say
from megastep.agents.cli.settings import Evaluate
from megastep.agents.training import evaluation

HELP = """Measures what a run's agent earns in the first episode of each lane, with a 95 % interval over
homes. Prints a table and writes it to the run's folder: evaluations/*.md.

The most common words:
  run=RUN              a run folder, one of its checkpoints, or latest
  split=training       the homes it was trained in, instead of unseen ones
  geometry=bench       other homes
  env=pong             another environment with the same spaces: after self-play, the tracker
  greedy=true          the most likely actions instead of sampled ones
  episodes=256         fewer episodes
  baseline=false       no row for random actions
  against=RUN,bot      duels instead: with other runs or checkpoints, the scripted policy, random
                       actions, or an import path
  ratings=true         ratings of the run's snapshots, by duels of each with each"""


def run(cfg: Evaluate) -> Path:
    """Evaluates a run, each environment in one home throughout. Returns the path of the table.

    Writes .json and .md into the run's folder `evaluations`, one of each per source of geometries
    (per environment where it has none), split and checkpoint. With `cfg.against` plays duels
    instead; with `cfg.ratings` writes ratings.csv and ratings.svg.
    """
    start, device = time.monotonic(), factory.make_device(cfg.device)
    loaded = factory.load_checkpoint(runs.find(cfg.run), device)
    trained = factory.config_of(loaded)
    settings, geometry = cfg.env or trained.env, cfg.geometry or trained.geometry
    if cfg.ratings or cfg.against is not None:
        arena = duels.Arena(cfg, loaded, settings, geometry, device)
        path = arena.rate() if cfg.ratings else arena.duel()
    else:
        path = _evaluate(cfg, loaded, trained, settings, geometry, device)
    say(f"Evaluated in {duration(time.monotonic() - start)}")
    return path


def _evaluate(cfg, loaded, trained, settings, geometry, device):
    homes = factory.homes(settings, geometry, cfg.split, cfg.episodes)
    settings = factory.changed(settings, n_envs=cfg.episodes, resample=False)
    env = factory.make_env(settings, homes, cfg.seed, device)
    policy = factory.make_policy(trained.agent, env)
    factory.load_weights(policy, env, loaded)
    players = {"trained, greedy" if cfg.greedy else "trained": policy}
    if cfg.baseline:
        players["random"] = evaluation.RandomActions(env.action_space)
    rows = []
    for name, player in players.items():
        episodes = evaluation.first_episodes(env, player, cfg.seed, cfg.greedy and player is policy)
        summaries = evaluation.summaries(episodes, getattr(env, "roles", None))
        rows += [{"agent": name, **row} for row in summaries]
    where, source = runs.place(settings, geometry, homes, cfg.split)
    title = (
        f"{where}, after {loaded.step:,} samples ({loaded.path.name}), seed {cfg.seed}, "
        f"{env.n_envs * env.n_agents:,} lanes"
    )
    names = [source, "env" if cfg.env else "", cfg.split, str(loaded.step)]
    return runs.write_table(cfg, loaded, names, title, rows, [cells(row) for row in rows])


def cells(row: dict) -> dict[str, str]:
    """Returns a row of the table as text by column: each metric, and its interval, on its own."""
    cut = f", {row['unfinished']} cut short" if row["unfinished"] else ""
    metrics = {}
    for name, metric in row["metrics"].items():
        has_mean = metric["mean"] is not None
        metrics[name] = f"{metric['mean']:.3g}" if has_mean else "none"
        interval = f"{metric['lower']:.3g} to {metric['upper']:.3g}" if has_mean else "none"
        metrics[f"{name}: {runs.INTERVAL}"] = interval
    return {
        "agent": f"{row['agent']}: {row['role']}" if "role" in row else row["agent"],
        "return": f"{row['return']:.2f}",
        runs.INTERVAL: f"{row['lower']:.2f} to {row['upper']:.2f}",
        **metrics,
        "length": f"{row['length']:.0f}",
        "episodes": f"{row['lanes']}{cut}",
        "homes": str(row["homes"] or "none"),
    }


def main(argv: list[str] | None = None) -> int:
    words = sys.argv[1:] if argv is None else argv
    # a list of names, not the sweep that Hydra takes it for
    words = [re.sub(r"^against=(?!\[|null$)(.*)", r"against=[\1]", word) for word in words]
    return run_command(SCRIPT, words)


SCRIPT = Script("evaluate", Evaluate, run, HELP)
