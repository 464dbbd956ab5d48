"""Trains, in this process or with several ranks in processes of their own."""

import contextlib
import functools
import itertools
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from megastep import engine
from megastep.agents import console, factory, package
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.distributed import process_group
from megastep.agents.distributed.agreement import from_rank_0, together
from megastep.agents.distributed.drift import DriftError
from megastep.agents.errors import (
    EnvFailed,
    NonFinite,
    UserError,
    memory_problem,
)
from megastep.agents.evaluation import in_training
from megastep.agents.factory import env_failures, settings
from megastep.agents.factory.trainer import make_trainer
from megastep.agents.launch import (
    again,
    compare,
    dry_run,
    finishing,
    gpu,
    launcher,
    population,
    rank,
    rank_checks,
    signals,
)
from megastep.agents.launch.watch import Team
from megastep.agents.runs import folders, provenance
from megastep.agents.training import curves
from megastep.agents.training.budget import reaches
from megastep.agents.training.callbacks import Progress
from megastep.agents.training.trainer import Trainer


def open_folder(cfg: settings.Train, locks: contextlib.ExitStack) -> tuple[Path, str | None]:
    """Returns the run folder, locked, and the path to resume from (None for a new run)."""
    if is_new := cfg.resume in (None, again.AUTO):
        folder = folders.new(settings.run_name(cfg), cfg.folder, cfg.resume == again.AUTO)
    else:
        folder = folders.folder_of(folders.find(cfg.resume))
    locks.enter_context(folders.locked(folder))
    if is_new:
        return folder, None
    if cfg.resume and process_group.n_ranks() > 1:  # all ranks from the same intact checkpoint
        return folder, str(folders.load_checkpoint(folders.find(cfg.resume), cfg.trust).path)
    return folder, cfg.resume


def run(cfg: settings.Train) -> Path | None:
    """Trains. Returns the run folder, None for a dry run.

    If torchrun started this process, it trains as one of the ranks; rank 0 writes the run folder.
    With `cfg.ranks` or `cfg.restarts`, this process starts the ranks and waits for them.

    Raises:
        Interrupted: a signal came; the run was saved.
        UserError: training cannot start or continue.
    """
    if cfg.dry_run:
        return dry_run.show(cfg)
    if cfg.population.size > 1:  # from Python; a command has asked before its driver started
        gpu.ask_for_queues()
    if launcher.is_needed(cfg):
        return launcher.run(cfg)
    with rank.joined() as team:
        if cfg.population.size > 1 and cfg.population.member is None:
            return population.run(cfg, team)
        return train_here(cfg, team)


def train_here(cfg: settings.Train, team: Team | None) -> Path:
    """Trains in this process, alone or as one rank of a team. Returns the run folder."""
    is_first = process_group.rank() == 0
    device = together(lambda: factory.make_device(cfg.device, process_group.local_rank()))
    progress = console.Progress()

    if cfg.resume == again.AUTO:
        start = together(lambda: again.automatic(cfg))
        if start.is_done:
            why = "reached its stop" if start.is_reached else "used up its budget"
            console.say(f"The run in {start.folder} has already {why}.")
            return start.folder
        cfg = start.cfg
    is_new = not cfg.resume or (cfg.resume == again.AUTO and not os.path.exists(str(cfg.folder)))
    rank_checks.check_start(cfg)
    cfg = rank_checks.started_again(cfg, team)
    with contextlib.ExitStack() as locks:
        with contextlib.ExitStack() as undo:
            with signals.deferred():
                folder, resume = from_rank_0(lambda: open_folder(cfg, locks))
                if is_first and is_new:
                    undo.callback(shutil.rmtree, folder, ignore_errors=True)
            token = rank_checks.check_shared(folder)
            if team:
                team.set_folder(folder)
            cfg = together(lambda: again.with_more(settings.changed(cfg, resume=resume)))
            try:
                trainer = together(
                    env_failures.told(cfg.env, folder, rank=process_group.rank())(
                        lambda: make_trainer(
                            *(cfg, folder, device, token),
                            callbacks=[Progress(progress.show)],
                            make_evaluator=in_training.Evaluator,
                        )
                    )
                )
            except EnvFailed:
                undo.pop_all()  # the folder has the traceback
                raise
            rank_checks.check_world(cfg, trainer)
            from_rank_0(
                functools.partial(folders.write_config, folder, trainer.saver.config["train"])
            )
            hosts = process_group.gather_objects(process_group.hostname())
            clauses = dict.fromkeys(itertools.chain(*process_group.gather_objects(trainer.lost)))
            if is_first:
                if clauses:
                    console.say(f"Resuming, but not bit for bit: {'; '.join(clauses)}.")
                folders.record_start(folder)
                provenance.record(
                    folder, trainer.samples, device, package.version(), package.ROOT, hosts
                )
                if cfg.device == "auto":
                    gpu.warn_of_job_without()
                ranks = f"{len(hosts)} x {device.type}" if len(hosts) > 1 else device
                console.say(f"Training on {ranks} in {folder}")
            undo.pop_all()
        saved = functools.partial(saved_by, trainer, folder)
        try:
            with (
                env_failures.told(cfg.env, folder, saved, process_group.rank()),
                signals.handled() as numbers,
                progress if is_first else contextlib.nullcontext(),
                contextlib.closing(trainer),
            ):
                trainer.train(lambda: bool(numbers))
        except NonFiniteError as error:
            saved = f"Earlier checkpoints are in {folder}{trainer.nonfinite_guard.hint}"
            raise NonFinite(f"{error}. {saved}") from error
        except DriftError as error:
            raise UserError(f"{error}. Earlier checkpoints are in {folder}") from error
        except (MemoryError, RuntimeError) as error:
            problem = memory_problem(error)
            if not (problem or isinstance(error, engine.EngineError)):
                raise
            reason = problem or str(error).partition("\n")[0].rstrip(".")
            raise UserError(f"{reason}. {saved()}") from error
        finally:
            if is_first:
                with process_group.unhurried():
                    curves.plot_curves(folder)
        # all ranks stop if one got a signal or could not save a checkpoint
        ends = process_group.gather_objects((numbers[:1], trainer.saver.error))
        if signal := next((numbers[0] for numbers, _ in ends if numbers), None):
            raise signals.Interrupted(
                signal,
                f"Stopped after {trainer.samples:,} samples. {folders.to_continue(folder)}",
            )
        if unsaved := next((error for _, error in ends if error), None):
            raise UserError(unsaved)
        nonfinite, hint = trainer.nonfinite_guard.value, trainer.nonfinite_guard.hint
        result, samples = result_of(trainer, cfg.evaluation.stop), trainer.samples
        del trainer, saved  # frees GPU memory for the evaluation
        finishing.finish(cfg, folder, samples)
        if nonfinite and nonfinite.is_from_env:
            learnt = f"All other rollouts were used; the run is in {folder}"
            raise NonFinite(f"{nonfinite}. {learnt}{hint}")
        if cfg.rerun and is_first:
            compare.run(folder, Path(cfg.rerun))
        if is_first:
            console.say(f"{result}. The run is in {folder}\n{next_command(cfg, folder)}")
    return folder


def result_of(trainer: Trainer, stop: Mapping[str, float]) -> str:
    """Returns what a run came to: samples, seconds, and the return of its last episodes."""
    text = f"Trained {trainer.samples:,} samples in {console.duration(trainer.clock.seconds)}"
    if reaches(trainer.evaluation, stop):
        goals = ", ".join(
            f"{name} {trainer.evaluation[name]:.4g} (evaluation.stop.{name}={goal:g})"
            for name, goal in stop.items()
        )
        return f"{text}, when an evaluation had {goals}"
    latest = trainer.latest_stats
    if "episode/return" not in latest:
        return f"{text}; no episode ended since the last report"
    n_episodes = f"{latest['episode/window']:,.0f}"
    return f"{text}; mean return {latest['episode/return']:.4g} of the last {n_episodes} episodes"


def next_command(cfg: settings.Train, folder: Path) -> str:
    """Returns what people do next with a run that has ended: evaluate it, film it, or continue."""
    if not cfg.finish.evaluate:
        return f"To evaluate it: {folders.command_of('evaluate', 'run', folder)}"
    if not cfg.finish.record:
        return f"To film it: {folders.command_of('record', 'run', folder)}"
    return f"To train it further: {folders.resume_command(folder)} more_seconds=10min"


def saved_by(trainer: Trainer, folder: Path) -> str:
    """Returns how much of a run that ended with an error is saved, and how to resume it."""
    text = trainer.saver.error or "The latest updates could not be saved"
    text = f"All {trainer.samples:,} samples are saved" if trainer.is_saved else text
    return f"{text}. {folders.to_continue(folder)}"
