"""Measures a trained policy on unseen homes. `python evaluate.py --help`; `run(cfg)` is the same
from Python.
"""

import dataclasses
import json
import time

from agents import evaluation
from agents.cli import components, run_folders
from agents.cli.command import run_command
from agents.cli.console import duration, say, table
from agents.cli.settings import Evaluate, UserError

HELP = """Prints and writes what a run's agent earns in the first episode of each lane, with a 95 %
interval over homes.

The commonest:
  run=RUN              a run folder, one of its checkpoints, or latest
  split=training       the homes it was trained in, instead of unseen ones
  geometry=bench       other homes altogether
  greedy=true          the likeliest actions instead of sampled ones
  lanes=256            fewer episodes
  baseline=false       no row for random actions"""
COLUMNS = ("agent", "return", "95 % interval", "length", "episodes", "homes")


def run(cfg):
    """Evaluates as `cfg`, a settings.Evaluate, says. Writes evaluation.json and .md in the run's
    folder; returns it.
    """
    device, path = components.make_device(cfg.device), run_folders.find(cfg.run)
    loaded = components.load(path, device)
    trained = components.config_of(loaded)
    homes = components.homes(cfg.geometry or trained.geometry, cfg.split, cfg.lanes)
    env = components.make_env(
        dataclasses.replace(trained.env, n_envs=cfg.lanes), homes, cfg.seed, device
    )
    policy = components.make_policy(trained.agent, env)
    components.load_weights(policy, env, loaded)
    players = {"trained, greedy" if cfg.greedy else "trained": policy}
    if cfg.baseline:
        players["random"] = evaluation.RandomActions(env.action_space)

    start, rows = time.monotonic(), []
    homes_of_lanes = [e % len(homes) for e in range(env.n_envs) for _ in range(env.n_agents)]
    for name, player in players.items():
        episodes = evaluation.first_episodes(env, player, cfg.seed, cfg.greedy and player is policy)
        rows.append({"agent": name, **evaluation.summary(episodes, homes_of_lanes)})
    geometry = (cfg.geometry or trained.geometry).name
    title = (
        f"{trained.env.name} in the {cfg.split} homes of {geometry}, after {loaded.step:,} samples"
    )
    say(table(COLUMNS, [cells(row) for row in rows], title))
    say(f"evaluated in {duration(time.monotonic() - start)}")
    folder = run_folders.folder_of(path)
    write(
        folder,
        dict(
            title=title, checkpoint=str(loaded.path), evaluation=dataclasses.asdict(cfg), rows=rows
        ),
    )
    return folder


def cells(row):
    """A row of the table, as text."""
    cut = f", {row['unfinished']} cut short" if row["unfinished"] else ""
    return (
        row["agent"],
        f"{row['return']:.2f}",
        f"{row['low']:.2f} to {row['high']:.2f}",
        f"{row['length']:.0f}",
        f"{row['lanes']}{cut}",
        str(row["homes"]),
    )


def write(folder, result):
    """Writes a result for machines and for people."""
    lines = [
        "| " + " | ".join(line) + " |"
        for line in (COLUMNS, ("---",) * len(COLUMNS), *map(cells, result["rows"]))
    ]
    try:
        (folder / "evaluation.json").write_text(json.dumps(result, indent=2) + "\n")
        (folder / "evaluation.md").write_text("\n".join([result["title"], "", *lines]) + "\n")
    except OSError as error:
        raise UserError(
            f"The evaluation cannot be written to {folder} ({error.strerror})"
        ) from error


def main(argv=None):
    return run_command("evaluate", Evaluate, run, HELP, argv)
