"""Trains, in this process or with several ranks in processes of their own."""

from pathlib import Path

from megastep.agents import console, factory
from megastep.agents.factory import settings
from megastep.agents.launch import gpu, launcher, rank
from megastep.agents.launch.population import PopulationRun
from megastep.agents.launch.run import Run
from megastep.agents.selfplay.opponents import count_environments
from megastep.agents.types import LearnerOptions, with_defaults
from megastep.types import n_lanes, optional


def run(cfg: settings.Train) -> Path | None:
    """Trains. Returns the run folder, None for a dry run.

    If torchrun started this process, it trains as one of the ranks; rank 0 writes the run folder.
    With `cfg.ranks` or `cfg.restarts`, this process starts the ranks and waits for them.

    Raises:
        Interrupted: a signal came; the run was saved.
        UserError: training cannot start or continue.
    """
    if cfg.dry_run:
        return dry_run(cfg)
    is_population = cfg.population.size > 1 and cfg.population.member is None
    if is_population:  # from Python; a command has asked before its driver started
        gpu.ask_for_queues()
    if launcher.is_needed(cfg):
        return launcher.run(cfg)
    with rank.joined() as team:
        return (PopulationRun if is_population else Run)(cfg, team).run()


def dry_run(cfg: settings.Train) -> None:
    """Prints environments, lanes and batch sizes, per rank or per member of a population, and in
    total. Writes no file.

    A machine without a GPU, such as a login node, tells the sizes of `device=cuda`, too.
    """
    n_ranks = launcher.n_ranks(cfg)
    is_elsewhere = cfg.device.startswith("cuda") and not gpu.is_available()
    device = factory.make_device("cpu" if is_elsewhere else cfg.device)
    kind = "cuda" if is_elsewhere else device.type
    n_members = cfg.population.size
    n, part = (n_members, "per member") if n_members > 1 else (n_ranks, "per rank")
    names = ["", part, "in total"] if n > 1 else ["", "in total"]
    rows = [
        [name, *(f"{number * factor:,}" for factor in {1: None, n: None})]
        for name, number in sizes(cfg, device).items()
    ]
    members = f" {n_members} members" if n_members > 1 else ""
    ranks = f"{n_ranks} x " if n_ranks > 1 else ""
    console.say(f"Would train{members} on {ranks}{kind}:\n{console.table(names, rows)}")


def sizes(cfg: settings.Train, device) -> dict[str, int]:
    """Returns the sizes of one rank by name; omits those that the learner does not define."""
    geometries = factory.homes(cfg.env, cfg.geometry, "training")
    options = dict(seed=cfg.seed, device=device, privileged=cfg.agent.critic == "asymmetric")
    sample = factory.make_sample(cfg.env, geometries, **options)
    lanes = cfg.env.n_envs * n_lanes(sample) // sample.n_envs
    learner = with_defaults(cfg.learner, LearnerOptions)
    numbers = {"environments": cfg.env.n_envs, "lanes": lanes}
    n_opponents = count_opponents(cfg, sample)
    if n_opponents:
        lanes -= n_opponents
        numbers["lanes that learn"] = lanes
    if learner.n_steps:
        numbers["samples per update"] = lanes * learner.n_steps
    if learner.n_steps and learner.n_minibatches:
        numbers["samples per minibatch"] = lanes * learner.n_steps // learner.n_minibatches
    return numbers


def count_opponents(cfg: settings.Train, sample) -> int:
    """Returns the number of lanes that opponents control. Raises UserError if they do not fit."""
    opponents = cfg.opponents
    if not (opponents.past or opponents.bot or opponents.league):
        return 0
    with factory.errors():
        shares = opponents.past, opponents.bot, opponents.snapshots, opponents.league
        n_per_snapshot, n_bot, n_per_rival = count_environments(sample, cfg.env.n_envs, *shares)
    n_past = (n_per_snapshot + n_per_rival) * opponents.snapshots
    return (n_past + n_bot) * (optional(sample, "n_agents") - 1)
