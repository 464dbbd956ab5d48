"""Trains a policy. `train --help` lists the choices; `run(cfg)` is the same from Python."""

import contextlib
import functools
import itertools
import math
import random
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from megastep import engine
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.cli import (
    check,
    command,
    console,
    dry_run,
    evaluate,
    factory,
    launch,
    program,
    rank,
    rank_checks,
    record,
    runs,
    scripts,
    settings,
    signals,
)
from megastep.agents.distributed import process_group
from megastep.agents.distributed.agreement import any_rank, from_rank_0, together
from megastep.agents.distributed.drift import DriftError
from megastep.agents.generator import SeededGenerator, rank_seed, stream_seed
from megastep.agents.training import (
    agent_file,
    annealing,
    budget,
    checkpoint,
    curves,
    loggers,
    provenance,
    saver,
)
from megastep.agents.training.atomic_files import write_atomically
from megastep.agents.training.rank_files import RankFiles
from megastep.agents.training.trainer import Trainer
from megastep.agents.types import LEARNER_DEFAULTS
from megastep.types import optional


def make_trainer(
    cfg: settings.Train,
    folder: Path,
    device: torch.device,
    progress: console.Progress,
    token: str = "",
) -> Trainer:
    """Returns a Trainer: continuing where a run stopped, or from the weights of another, if `cfg`
    says so.

    Each rank has one. All begin with the same weights; whatever else a seed decides differs.

    Args:
        token: a name that all ranks of this start have, and no other start.
    """
    number, n_ranks = process_group.rank(), process_group.n_ranks()
    seed = rank_seed(cfg.seed, number)
    seed_everything(seed)
    where = {
        "geometries": factory.homes(cfg.env, cfg.geometry, "training"),
        "seed": seed,
        "device": device,
        "privileged": cfg.agent.critic == "asymmetric",
    }
    sample = factory.make_sample(cfg.env, **where)
    policy = factory.make_policy(cfg.agent, sample, cfg.seed, cfg.agent.critic)
    policy.generator = SeededGenerator(stream_seed(seed, "policy"))
    learner = factory.make_learner(cfg.learner, policy, seed)
    cfg = annealed(cfg, optional(learner, "set_lr", LEARNER_DEFAULTS) is not None)
    n_copies = 2 if cfg.nonfinite_replay else 1  # of the environments' state
    factory.check_memory(cfg.env, sample, learner, n_copies, **where)
    env = factory.construct(cfg.env, **where)
    if cfg.resume or cfg.init:
        path = runs.find(cfg.resume or cfg.init)
        loaded = runs.load_checkpoint(path, cfg.trust, device, cfg.resume is not None, number)
        factory.load_weights(policy, env, loaded)
        if number == 0 and policy.critic is not None and agent_file.is_agent_file(path):
            console.say(f"{runs.name_of(path)} has no critic, so this run begins with a new one")
    opponents = factory.make_opponents(cfg, env, sample, policy, seed)
    for name in ("checkpoints", "snapshots") if cfg.resume and number == 0 else ():
        checkpoint.set_aside_after(folder / name, loaded.step)
    config = {"train": check.as_tree(cfg), "spaces": factory.spaces_of(env)}
    wandb = vars(cfg.logger) | {"name": folder.name, "config": config["train"]}
    made_with = provenance.made_with(device, program.version(), n_ranks)
    checkpoints, had = folder / "checkpoints", loaded.state if cfg.resume else Counter()
    with factory.errors():
        limits = budget_of(cfg, folder, loaded if cfg.resume else None)
        logger, writers = loggers.NoLogger(), {}
        rank_files = RankFiles(checkpoints, token, number, n_ranks)
        if number == 0:  # which alone writes these
            wandb = wandb if cfg.logger.name == "wandb" else None
            logger = loggers.Loggers(folder, had["samples_at_report"], wandb)
            snapshots = saver.Saver(folder / "snapshots", config, keep_checkpoints=10**9)
            writers = dict(
                on_log=lambda running: progress.show(*progress_of(running)),
                snapshot_saver=saver.SnapshotSaver(snapshots, cfg.snapshots),
                annealing_record=annealing.AnnealingRecord(folder, had["updates"]),
            )
        improves = Trainer(
            opponents or env,
            policy,
            learner,
            logger,
            saver.Saver(
                checkpoints, config, cfg.keep_checkpoints, made_with, cfg.replay_every, rank_files
            ),
            limits,
            log_every=cfg.log_every,
            checkpoint_seconds=cfg.checkpoint_seconds,
            desync=cfg.desync,
            opponents=opponents,
            make_curriculum=factory.make_curriculum(cfg.curriculum, where["geometries"]),
            layout_sources=factory.layout_sources(cfg.env, where["geometries"]),
            replay_folder=folder if cfg.nonfinite_replay else None,
            **writers,
        )
        if cfg.resume:
            improves.load_state_dict(loaded.state, is_new_rank=number >= loaded.n_ranks)
            improves.lost += differing(loaded.made_with, made_with)
    return improves


def differing(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Returns a clause for each of the things that a run's bits depend on that has changed."""
    before, now = {"ranks": 1, **before}, {"ranks": 1, **now}
    return [
        f"{name} was {value} and is {now.get(name)}"
        for name, value in before.items()
        if value != now.get(name)
    ]


def seed_everything(seed: int) -> None:
    """Seeds the global generators of PyTorch, NumPy and Python, which only code of the user's draws
    from.
    """
    seed = stream_seed(seed, "global")
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)


def budget_of(
    cfg: settings.Train, folder: Path, loaded: checkpoint.Checkpoint | None
) -> budget.Budget:
    """Returns the budget of a run, with the factors of the learning rate that are to be repeated.

    Raises:
        UserError: the run to repeat did not record them.
    """
    limits, recorded = (cfg.samples, cfg.seconds, cfg.learner.anneal), ()
    if cfg.rerun:
        source = runs.folder_of(runs.find(cfg.rerun))
        recorded = annealing.read(source)
        if not recorded or any(map(math.isnan, recorded)):
            raise program.UserError(
                f"{source} cannot be repeated: {annealing.FILE} does not hold the learning rate of "
                "each update, as an earlier version began the run; start a new one with its "
                f"settings, which are in {source / 'config.yaml'}"
            )
    elif loaded is not None:
        recorded = annealing.read(folder)
        # a clock of another budget would have chosen others
        if cfg.learner.anneal != "seconds" or loaded.config["train"]["seconds"] != cfg.seconds:
            recorded = recorded[: loaded.state["updates"]]
    return budget.Budget(*limits, recorded, is_rerun=cfg.rerun is not None)


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


def open_folder(cfg: settings.Train, locks: contextlib.ExitStack) -> tuple[Path, str | None]:
    """Returns the run folder, locked, and what to resume."""
    folder = runs.folder_of(runs.find(cfg.resume)) if cfg.resume else runs.new(cfg)
    locks.enter_context(runs.locked(folder))
    if cfg.resume and process_group.n_ranks() > 1:  # all from the newest one that is intact
        return folder, str(runs.load_checkpoint(runs.find(cfg.resume), cfg.trust).path)
    return folder, cfg.resume


def run(cfg: settings.Train) -> Path | None:
    """Trains as `cfg` says, and returns the run folder, None for a dry run. A signal saves and
    raises Interrupted.

    Where torchrun started this process as a rank, all ranks train together. Rank 0 writes. With
    `cfg.ranks`, other processes are started that do so.
    """
    if cfg.dry_run:
        return dry_run.show(cfg)
    if launch.is_needed(cfg):
        return launch.run(cfg)
    with rank.joined() as team:
        return train_here(cfg, team)


def train_here(cfg: settings.Train, team: rank.Team | None) -> Path:
    """Trains in this process, as one of a team of ranks if it is one. Returns the run folder."""
    is_first = process_group.rank() == 0
    device, progress = together(lambda: factory.make_device(cfg.device)), console.Progress()
    rank_checks.check_start(cfg)
    cfg = rank_checks.started_again(cfg, team)
    with contextlib.ExitStack() as locks:
        with contextlib.ExitStack() as undo:
            with signals.deferred():
                folder, resume = from_rank_0(lambda: open_folder(cfg, locks))
                if is_first and not cfg.resume:
                    undo.callback(shutil.rmtree, folder, ignore_errors=True)
            token = rank_checks.check_shared(folder)
            if team:
                team.set_folder(folder)
            cfg = together(lambda: with_more(settings.changed(cfg, resume=resume)))
            running = together(lambda: make_trainer(cfg, folder, device, progress, token))
            rank_checks.check_world(cfg, running)
            from_rank_0(functools.partial(write_config, folder, running.saver.config["train"]))
            hosts = process_group.gather_objects(process_group.hostname())
            clauses = dict.fromkeys(itertools.chain(*process_group.gather_objects(running.lost)))
            if is_first:
                if clauses:
                    console.say(f"This run goes on, but not bit for bit: {'; '.join(clauses)}.")
                runs.record_start(folder)
                provenance.record(
                    folder, running.samples, device, program.version(), program.ROOT, hosts
                )
                ranks = f"{len(hosts)} x {device.type}" if len(hosts) > 1 else device
                console.say(f"Training on {ranks} in {folder}")
            undo.pop_all()
        resume = f"To continue: {runs.resume_command(folder)}"
        try:
            with (
                signals.handled(rank.announce) as numbers,
                progress if is_first else contextlib.nullcontext(),
                contextlib.closing(running),
            ):
                running.train(lambda: bool(numbers))
                if not any_rank(bool(numbers)):
                    measure_sections(running)
        except NonFiniteError as error:
            saved = f"What was saved before is in {folder}{running.nonfinite_guard.replay_hint}"
            raise program.NonFinite(f"{error}. {saved}") from error
        except DriftError as error:
            raise program.UserError(f"{error}. What was saved before is in {folder}") from error
        except (MemoryError, RuntimeError) as error:
            problem = program.memory_problem(error)
            if not (problem or isinstance(error, engine.EngineError)):
                raise
            saved = running.saver.error or "What was learnt last could not be saved"
            saved = f"All {running.samples:,} samples are saved" if running.is_saved else saved
            reason = problem or str(error).partition("\n")[0].rstrip(".")
            raise program.UserError(f"{reason}. {saved}. {resume}") from error
        finally:
            if is_first:
                with process_group.unhurried():
                    curves.plot_curves(folder)
        times = running.section_times
        if is_first and times.is_known:
            console.say(console.sections(times.milliseconds(), times.iteration))
        # a signal that one rank got stops all, and so does a checkpoint that one could not save
        ends = process_group.gather_objects((numbers[:1], running.saver.error))
        if signal := next((numbers[0] for numbers, _ in ends if numbers), None):
            raise signals.Interrupted(
                signal, f"Stopped after {running.samples:,} samples. {resume}"
            )
        if unsaved := next((error for _, error in ends if error), None):
            raise program.UserError(unsaved)
        nonfinite, replay = running.nonfinite_guard.value, running.nonfinite_guard.replay_hint
        del running  # its memory is the evaluation's now
        common = dict(run=str(folder), split="test", greedy=False, seed=cfg.seed, device=cfg.device)
        common["trust"] = True  # what it names has just run
        if cfg.finish.evaluate:
            with process_group.unhurried():
                episodes = cfg.finish.episodes
                evaluate.run(settings.Evaluate(episodes=episodes, baseline=True, **common))
        if cfg.finish.record and is_first:
            with console.warned():
                record.run(settings.Record(steps=cfg.finish.steps, home=0, file=None, **common))
        if nonfinite and nonfinite.is_from_env:
            learnt = f"All else was learnt from, and is in {folder}"
            raise program.NonFinite(f"{nonfinite}. {learnt}{replay}")
        if cfg.rerun and is_first:
            compare(folder, runs.folder_of(runs.find(cfg.rerun)))
    return folder


def measure_sections(running: Trainer) -> None:
    """Measures where an iteration's time goes; the training is done, and no failure may end it."""
    try:
        running.measure_sections()
    except RuntimeError as error:
        reason = str(error).partition("\n")[0]
        console.warn(f"the sections of an iteration could not be measured: {reason}")


def write_config(folder: Path, config: dict[str, Any]) -> None:
    """Writes a run's configuration into its folder."""
    with program.errors(runs.CANNOT.format(folder)):
        text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True, encoding="utf-8")
        write_atomically(folder / "config.yaml", text)


def compare(folder: Path, original: Path) -> None:
    """Says whether two runs have the same metrics, byte for byte. Raises Differs if not."""
    ours, theirs = ((run / "metrics.jsonl").read_bytes() for run in (folder, original))
    if ours == theirs:
        console.say(f"metrics.jsonl equals that of {original}, byte for byte.")
        return
    pairs = enumerate(itertools.zip_longest(ours.split(b"\n"), theirs.split(b"\n")), 1)
    number = next(number for number, (one, other) in pairs if one != other)
    raise program.Differs(
        f"metrics.jsonl differs from that of {original} from line {number} on; equal bits need the "
        f"same versions, device and threads: see {provenance.FILE} of both"
    )


#: Runs the script with words of a command line, by default this process's.
main = functools.partial(command.run_command, scripts.TRAIN)
