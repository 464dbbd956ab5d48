"""Trains, in this process or with several ranks in processes of their own."""

import os
import sys
import traceback
import warnings
from pathlib import Path

from megastep import workers
from megastep.agents import console
from megastep.agents.errors import shortened
from megastep.agents.factory import check, settings
from megastep.agents.factory import make as factory
from megastep.agents.launch import endings, gpu, launcher, rank
from megastep.agents.launch.run import Run
from megastep.agents.runs import typed_json
from megastep.agents.types import LearnerOptions, with_defaults
from megastep.types import n_lanes, optional


def run(cfg: settings.Train) -> Path | None:
    """Trains, with other ranks if there are. Returns the folder, None of a dry run. Interrupted."""
    if cfg.dry_run:
        return dry_run(cfg)
    is_population = cfg.population.size > 1 and cfg.population.member is None
    if is_population:  # from Python; a command has asked before its driver started
        gpu.ask_for_queues()
    if launcher.is_needed(cfg):
        return launcher.run(cfg)
    kind = Run
    if is_population:
        from megastep.agents.launch.population import PopulationRun as kind
    with rank.joined() as team:
        return kind(cfg, team).run()


def run_rank() -> int:
    """Trains as one of the ranks of `launcher`. Returns the exit code: 0 if it says how."""
    facts = typed_json.loads(Path(os.environ[endings.JOB], endings.SETTINGS).read_text())
    sys.argv[:], sys.orig_argv[:] = facts["argv"], facts["command"]
    workers.end_with_parent(facts["parent"])
    console.open_streams()
    console.prefix = facts["prefix"]
    warnings.showwarning = console.warn
    code = 0
    try:
        ending = endings.ending_of(lambda: run(check.check(settings.Train, facts["settings"])))
    except Exception as error:
        traceback.print_exc()
        ending = endings.Ending(1, f"{type(error).__name__}: {shortened(error, 400)}")
        code = 1
    if ending.text or ending.folder:
        endings.report_ending(ending)
    return code


def dry_run(cfg: settings.Train) -> None:
    """Prints environments, lanes and batch sizes, and writes nothing; does not need the GPU."""
    n_ranks, n_members = launcher.n_ranks(cfg), cfg.population.size
    is_elsewhere = cfg.device.startswith("cuda") and not gpu.is_available()
    device = factory.make_device("cpu" if is_elsewhere else cfg.device)
    numbers = sizes(cfg, device)
    n, part = (n_members, "per member") if n_members > 1 else (n_ranks, "per rank")
    columns = {"in total": n} if n == 1 else {part: 1, "in total": n}
    rows = [
        [name, *(f"{number * factor:,}" for factor in columns.values())]
        for name, number in numbers.items()
    ]
    members = f" {n_members} members" if n_members > 1 else ""
    ranks = f"{n_ranks} x " if n_ranks > 1 else ""
    where = f"{ranks}{'cuda' if is_elsewhere else device.type}"
    console.say(f"Would train{members} on {where}:\n{console.table(['', *columns], rows)}")


def sizes(cfg: settings.Train, device) -> dict[str, int]:
    """Returns the sizes of one rank by name. UserError if the opponents do not fit."""
    geometries = factory.homes(cfg.env, cfg.geometry, "training")
    options = dict(seed=cfg.seed, device=device, privileged=cfg.agent.critic == "asymmetric")
    sample = factory.make_sample(cfg.env, geometries, **options)
    lanes = cfg.env.n_envs * n_lanes(sample) // sample.n_envs
    learner, opponents = with_defaults(cfg.learner, LearnerOptions), cfg.opponents
    numbers = {"environments": cfg.env.n_envs, "lanes": lanes}
    if opponents.past or opponents.bot or opponents.league:
        from megastep.agents.selfplay.opponents import count_environments

        with factory.errors():
            shares = opponents.past, opponents.bot, opponents.snapshots, opponents.league
            n_played = sum(count_environments(sample, cfg.env.n_envs, *shares).values())
        lanes -= n_played * (optional(sample, "n_agents") - 1)
        numbers["lanes that learn"] = lanes
    if learner.n_steps:
        numbers["samples per update"] = lanes * learner.n_steps
    if learner.n_steps and learner.n_minibatches:
        numbers["samples per minibatch"] = lanes * learner.n_steps // learner.n_minibatches
    return numbers
