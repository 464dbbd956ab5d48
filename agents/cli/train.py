"""Trains a policy. `train --help` lists the choices; `run(cfg)` is the same from Python."""

import dataclasses
from collections.abc import Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import torch

from megastep import engine
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.cli import evaluate, factory, record, runs, settings, signals
from megastep.agents.cli.check import as_tree
from megastep.agents.cli.command import run_command
from megastep.agents.cli.compose import Script
from megastep.agents.cli.console import Progress, duration, number, say, warn
from megastep.agents.cli.program import ConfigErrors, UserError, first_line
from megastep.agents.training import checkpoint, loggers, trainer
from megastep.agents.training.budget import Budget
from megastep.agents.training.saver import Saver, Snapshots

HELP = """Trains a policy in an environment.

The most common words:
  experiment=quickstart        the recipe of `make train`: train, evaluate on unseen homes, film
  env=minimal geometry=box     another environment, other homes
  seconds=60 samples=1e6       when to stop, whichever comes first; Ctrl-C stops too, and saves
  preset=gpu env.n_envs=256    the sizes for a GPU, or your own
  learner.lr=3e-4 seed=2       any key that --cfg job prints
  learner=vtrace               instead of ppo: learner.lag=1 acts while it learns,
                               learner.buffer=replay also learns from old experience
  finish.evaluate=true finish.record=true
                               a table and a video at the end
  opponents.past=0.4 opponents.bot=0.1
                               in environments with several agents: shares of environments against
                               past selves and a scripted policy; snapshots=8 keeps what ratings
                               compare
  resume=RUN                   continue a run (its folder, or latest) under its own configuration
  init=RUN                     start a new run from its weights, in its environment
  env=my_package.rover:Rover   a class of your own; also for geometry, learner, agent.core
  logger=wandb logger.mode=offline"""
#: The most metrics and groups of lanes that are shown beside the return.
FEW = 4
#: The prefix of metrics with the share of pairs won, by kind of opponent.
WON = "episode/won/"
#: What may change when a run is resumed: where it runs, when it stops, what it leaves behind; never
#: what it learns.
RESUMABLE = (
    "resume",
    "samples",
    "seconds",
    "device",
    "log_every",
    "checkpoint_seconds",
    "keep_checkpoints",
    "snapshots",
    "logger",
    "finish",
)


def make_trainer(
    cfg: settings.Train, folder: Path, device: torch.device, progress: Progress
) -> trainer.Trainer:
    """Returns a Trainer: continuing where a run stopped, or from the weights of another, if `cfg`
    says so.
    """
    homes = factory.homes(cfg.env, cfg.geometry, "training")
    where = homes, cfg.seed, device, cfg.agent.critic == "asymmetric"
    sample = factory.make_sample(cfg.env, *where)
    policy = factory.make_policy(cfg.agent, sample, cfg.seed, cfg.agent.critic)
    learner = factory.make_learner(cfg.learner, policy, cfg.seed)
    replayed = factory.replay_bytes(learner, sample) / cfg.env.n_envs
    factory.check_memory(cfg.env, sample, learner.bytes_per_env(sample) + replayed, *where)
    env = factory.make_env(cfg.env, *where)
    if cfg.resume or cfg.init:
        loaded = factory.load_checkpoint(runs.find(cfg.resume or cfg.init), device)
        factory.load_weights(policy, env, loaded)
    opponents = factory.make_opponents(cfg, env, sample, policy)
    wandb = None
    if cfg.logger.name == "wandb":
        wandb = dict(vars(cfg.logger), name=folder.name, config=as_tree(cfg))
    if cfg.resume:
        for name in ("checkpoints", "snapshots"):
            checkpoint.rewind(folder / name, loaded.step)
    config = {"train": as_tree(cfg), "spaces": factory.spaces_of(env)}
    with factory.errors():
        trains = trainer.Trainer(
            opponents or env,
            policy,
            learner,
            loggers.Loggers(folder, loaded.step if cfg.resume else 0, wandb),
            Saver(folder / "checkpoints", config, cfg.keep_checkpoints),
            Budget(cfg.samples, cfg.seconds, cfg.learner.anneal),
            report_every=cfg.log_every,
            save_every=cfg.checkpoint_seconds,
            on_report=lambda trains: progress.show(*progress_of(trains)),
            opponents=opponents,
            snapshots=Snapshots(Saver(folder / "snapshots", config, keep=10**9), cfg.snapshots),
        )
        if cfg.resume:
            trains.load_state_dict(loaded.state)
    return trains


def progress_of(trains: trainer.Trainer) -> tuple[float | None, list[str]]:
    """Returns the fraction of the budget that is spent, None without one, and the few numbers that
    people watch.
    """
    words, left, latest = [f"{number(trains.samples)} samples"], trains.left, trains.latest
    if trains.rate is not None:
        words.append(f"{number(trains.rate)}/s")
    if trains.score is not None:
        words.append(f"return {trains.score:.3g}")
        words += few_means(latest, trains.episode_stats.metrics, trains.episode_stats.groups)
        won = {name.removeprefix(WON): latest[name] for name in latest if name.startswith(WON)}
        words += [f"won vs {opponent} {share:.0%}".replace("%", " %") for opponent, share in won.items()]
    if not trains.budget.is_limited:
        return None, words
    if left < 1:
        words.append(f"{duration(trains.clock.seconds * left / (1 - left))} left")
    return 1 - left, words


def few_means(latest: dict[str, float], metrics: Sequence[str], groups: Sequence[str]) -> list[str]:
    """Returns the returns of groups of lanes, and metrics, if they are few enough for one line."""
    names = {group: f"episode/return/{group}" for group in groups}
    names |= {name: f"episode/{name}" for name in metrics}
    shown = [f"{name} {latest[key]:.3g}" for name, key in names.items() if key in latest]
    return shown if len(names) <= FEW else []


def annealed(cfg: settings.Train) -> settings.Train:
    """Returns `cfg` with learner.anneal=auto replaced: samples if limited, else seconds, else never."""
    if cfg.learner.anneal != "auto":
        return cfg
    limits = [name for name in ("samples", "seconds") if getattr(cfg, name) is not None]
    learner = dataclasses.replace(cfg.learner, anneal=[*limits, "never"][0])
    return dataclasses.replace(cfg, learner=learner)


def run(cfg: settings.Train) -> Path:
    """Trains as `cfg` says. Returns the run folder; after a signal, saves and raises Interrupted."""
    cfg, device = annealed(cfg), factory.make_device(cfg.device)
    folder = runs.folder_of(runs.find(cfg.resume)) if cfg.resume else runs.new(cfg)
    with runs.locked(folder):
        with nullcontext() if cfg.resume else runs.cleanup_on_error(folder):
            progress = Progress()
            trains = make_trainer(cfg, folder, device, progress)
            runs.write_config(folder, cfg)
        runs.record_start(folder)
        say(f"Training on {device} in {folder}")
        resume, saver = f"To continue: {runs.resume_command(folder)}", trains.save_checkpoint
        try:
            with signals.handled() as numbers, progress, closing(trains.metrics):
                trains.train(lambda: bool(numbers))
        except NonFiniteError as error:
            raise UserError(f"{error}. What was saved before is in {folder}", 1) from error
        except (engine.EngineError, torch.OutOfMemoryError) as error:
            saved = saver.unsaved or "What was learnt last could not be saved"
            if trains.is_saved:
                saved = f"All {trains.samples:,} samples are saved"
            raise UserError(f"{first_line(error).rstrip('.')}. {saved}. {resume}") from error
        finally:
            loggers.curves(folder)
        if numbers:
            stopped = f"Stopped after {trains.samples:,} samples. {resume}"
            raise signals.Interrupted(numbers[0], stopped)
        if saver.unsaved:
            raise UserError(saver.unsaved)
        nonfinite = trains.nonfinite_value
        del trains  # its memory is the evaluation's now
        finish(cfg, folder)
        if nonfinite and nonfinite.is_from_env:
            raise UserError(f"{nonfinite}. All else was learnt from, and is in {folder}", 1)
    return folder


def finish(cfg: settings.Train, folder: Path) -> None:
    """Evaluates and films the trained agent, if asked to."""
    common = dict(run=str(folder), split="test", greedy=False, seed=cfg.seed, device=cfg.device)
    if cfg.finish.evaluate:
        evaluate.run(settings.Evaluate(episodes=cfg.finish.episodes, baseline=True, **common))
    if cfg.finish.record:
        try:
            record.run(settings.Record(steps=cfg.finish.steps, home=0, file=None, **common))
        except UserError as error:
            warn(error)


def prepare(tree: dict[str, Any], typed: list[str]) -> dict[str, Any]:
    """Returns the tree of a run that resumes another or starts from its weights; any other is
    returned as it is.

    A run that is resumed keeps its own settings, except for typed keys. A run that starts from the
    weights of another has its environment and agent, except for typed keys and groups.
    """
    resume, init = tree.get("resume"), tree.get("init")
    if not isinstance(resume or init, str) or (resume and init):
        return tree
    if refused := [key for key in typed if resume and key.split(".")[0] not in RESUMABLE]:
        cure = "cannot change when a run is resumed; init=RUN starts a new one from its weights"
        raise ConfigErrors((key, cure) for key in refused)
    loaded = factory.load_checkpoint(runs.find(resume or init))
    saved, state = loaded.config["train"], loaded.state
    if init:
        groups = [group for group in ("env", "agent") if group not in typed]
        keys = [key for key in typed if key.partition(".")[0] in groups]
        return tree | _copied(tree, {group: saved[group] for group in groups}, keys)
    if "learner" not in state:
        raise UserError(
            f"{loaded.path} is a snapshot, which has the weights alone. init={loaded.path} starts a "
            "new run from it; resume= takes the run's folder"
        )
    saved = _copied(tree, saved, typed) | {"init": None}
    if spent := [
        (name, f"the run has had {round(state[name], 1):,} of {saved[name]:,}; give {name}= more")
        for name in ("samples", "seconds")
        if saved[name] is not None and state[name] >= saved[name]
    ]:
        raise ConfigErrors(spent)
    return saved


def _copied(source: dict, target: dict, keys: list[str]) -> dict:
    """Copies dotted keys from one tree to another, and returns it."""
    for key in keys:
        *groups, leaf = key.split(".")
        below, above = target, source
        for group in groups:
            below, above = below[group], above[group]
        below[leaf] = above[leaf]
    return target


SCRIPT = Script("train", settings.Train, run, HELP, prepare)


def main(argv: list[str] | None = None) -> int:
    return run_command(SCRIPT, argv)
