"""Trains a policy. `train --help` lists the choices; `run(cfg)` is the same from Python."""

import contextlib
import functools
import shutil
from collections.abc import Sequence
from pathlib import Path

import torch
import yaml

from megastep import engine
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.cli import (
    check,
    command,
    console,
    evaluate,
    factory,
    program,
    record,
    runs,
    scripts,
    settings,
    signals,
)
from megastep.agents.training import budget, checkpoint, curves, loggers, provenance, saver
from megastep.agents.training.atomic_files import write_atomically
from megastep.agents.training.trainer import Trainer
from megastep.agents.types import LEARNER_DEFAULTS
from megastep.types import optional


def make_trainer(
    cfg: settings.Train, folder: Path, device: torch.device, progress: console.Progress
) -> Trainer:
    """Returns a Trainer: continuing where a run stopped, or from the weights of another, if `cfg`
    says so.
    """
    where = {
        "geometries": factory.homes(cfg.env, cfg.geometry, "training"),
        "seed": cfg.seed,
        "device": device,
        "privileged": cfg.agent.critic == "asymmetric",
    }
    sample = factory.make_sample(cfg.env, **where)
    policy = factory.make_policy(cfg.agent, sample, cfg.seed, cfg.agent.critic)
    learner = factory.make_learner(cfg.learner, policy, cfg.seed)
    cfg = annealed(cfg, optional(learner, "set_lr", LEARNER_DEFAULTS) is not None)
    factory.check_memory(cfg.env, sample, learner, **where)
    env = factory.construct(cfg.env, **where)
    if cfg.resume or cfg.init:
        loaded = runs.load_checkpoint(runs.find(cfg.resume or cfg.init), cfg.trust, device)
        factory.load_weights(policy, env, loaded)
    opponents = factory.make_opponents(cfg, env, sample, policy)
    for name in ("checkpoints", "snapshots") if cfg.resume else ():
        checkpoint.set_aside_after(folder / name, loaded.step)
    config = {"train": check.as_tree(cfg), "spaces": factory.spaces_of(env)}
    wandb = vars(cfg.logger) | {"name": folder.name, "config": config["train"]}
    with factory.errors():
        improves = Trainer(
            opponents or env,
            policy,
            learner,
            loggers.Loggers(
                folder,
                loaded.step if cfg.resume else 0,
                wandb if cfg.logger.name == "wandb" else None,
            ),
            saver.Saver(folder / "checkpoints", config, cfg.keep_checkpoints),
            budget.Budget(cfg.samples, cfg.seconds, cfg.learner.anneal),
            log_every=cfg.log_every,
            checkpoint_seconds=cfg.checkpoint_seconds,
            desync=cfg.desync,
            on_log=lambda running: progress.show(*progress_of(running)),
            opponents=opponents,
            snapshot_saver=saver.SnapshotSaver(
                saver.Saver(folder / "snapshots", config, keep_checkpoints=10**9), cfg.snapshots
            ),
        )
        if cfg.resume:
            improves.load_state_dict(loaded.state)
    return improves


def progress_of(running: Trainer) -> tuple[float | None, list[str]]:
    """Returns the fraction of the budget that is spent, None without one, and the few numbers that
    people watch.
    """
    words, left, latest = (
        [f"{console.number(running.samples)} samples"],
        running.fraction_left,
        running.latest_stats,
    )
    if running.samples_per_second is not None:
        words.append(f"{console.number(running.samples_per_second)}/s")
    if "episode/return" in latest:
        n_episodes = console.number(latest["episode/window"])
        words.append(f"return {latest['episode/return']:.3g} of {n_episodes} episodes")
        words += few_means(latest, running.episode_stats.metrics, running.episode_stats.groups)
        won = [(k.partition("episode/won/")[2], share) for k, share in latest.items()]
        words += [f"won vs {opponent} {100 * share:.0f} %" for opponent, share in won if opponent]
    if running.budget.is_limited and left < 1:
        words.append(f"{console.duration(running.clock.seconds * left / (1 - left))} left")
    return 1 - left if running.budget.is_limited else None, words


def few_means(latest: dict[str, float], metrics: Sequence[str], groups: Sequence[str]) -> list[str]:
    """The returns of groups of lanes, and metrics, if they are few enough for one line."""
    names = {group: f"episode/return/{group}" for group in groups}
    names |= {name: f"episode/{name}" for name in metrics}
    shown = [f"{name} {latest[key]:.3g}" for name, key in names.items() if key in latest]
    return shown if len(names) <= 4 else []


def annealed(cfg: settings.Train, has_set_lr: bool = True) -> settings.Train:
    """Returns `cfg` with learner.anneal=auto replaced: by samples if limited, else by seconds if
    limited, else by never; by never if the learner has no `set_lr`.
    """
    limits = [n for n in ("samples", "seconds") if has_set_lr and getattr(cfg, n) is not None]
    anneal = [*limits, "never"][0] if cfg.learner.anneal == "auto" else cfg.learner.anneal
    return settings.changed(cfg, learner=settings.changed(cfg.learner, anneal=anneal))


def with_more(cfg: settings.Train) -> settings.Train:
    """Returns `cfg` with more_samples and more_seconds added to what the resumed run has had."""
    totals = {}
    for name in ("samples", "seconds"):
        if (more := getattr(cfg, f"more_{name}")) is not None:
            had = runs.load_checkpoint(runs.find(cfg.resume), cfg.trust).numbers[name]
            totals |= {name: had + more, f"more_{name}": None}
    return settings.changed(cfg, **totals)


def run(cfg: settings.Train) -> Path:
    """Trains as `cfg` says, and returns the run folder. A signal saves and raises Interrupted."""
    device, progress = factory.make_device(cfg.device), console.Progress()
    folder = runs.folder_of(runs.find(cfg.resume)) if cfg.resume else runs.new(cfg)
    with runs.locked(folder):
        cfg = with_more(cfg)
        with contextlib.ExitStack() as undo:
            if not cfg.resume:
                undo.callback(shutil.rmtree, folder, ignore_errors=True)
            running = make_trainer(cfg, folder, device, progress)
            with program.errors(runs.CANNOT.format(folder)):
                write_atomically(
                    folder / "config.yaml",
                    yaml.safe_dump(
                        running.saver.config["train"],
                        sort_keys=False,
                        allow_unicode=True,
                        encoding="utf-8",
                    ),
                )
            undo.pop_all()
        runs.record_start(folder)
        provenance.record(folder, running.samples, device, program.version(), program.ROOT)
        console.say(f"Training on {device} in {folder}")
        resume = f"To continue: {runs.resume_command(folder)}"
        try:
            with signals.handled() as numbers, progress, contextlib.closing(running.logger):
                running.train(lambda: bool(numbers))
        except NonFiniteError as error:
            raise program.NonFinite(f"{error}. What was saved before is in {folder}") from error
        except (MemoryError, RuntimeError) as error:
            problem = program.memory_problem(error)
            if not (problem or isinstance(error, engine.EngineError)):
                raise
            saved = running.saver.error or "What was learnt last could not be saved"
            saved = f"All {running.samples:,} samples are saved" if running.is_saved else saved
            reason = problem or str(error).partition("\n")[0].rstrip(".")
            raise program.UserError(f"{reason}. {saved}. {resume}") from error
        finally:
            curves.plot_curves(folder)
        if numbers:
            raise signals.Interrupted(
                numbers[0], f"Stopped after {running.samples:,} samples. {resume}"
            )
        nonfinite, unsaved = running.nonfinite_value, running.saver.error
        if unsaved:
            raise program.UserError(unsaved)
        del running  # its memory is the evaluation's now
        common = dict(run=str(folder), split="test", greedy=False, seed=cfg.seed, device=cfg.device)
        common["trust"] = True  # what it names has just run
        if cfg.finish.evaluate:
            evaluate.run(settings.Evaluate(episodes=cfg.finish.episodes, baseline=True, **common))
        if cfg.finish.record:
            with console.warned():
                record.run(settings.Record(steps=cfg.finish.steps, home=0, file=None, **common))
        if nonfinite and nonfinite.is_from_env:
            raise program.NonFinite(f"{nonfinite}. All else was learnt from, and is in {folder}")
    return folder


#: Runs the script with words of a command line, by default this process's.
main = functools.partial(command.run_command, scripts.TRAIN)
