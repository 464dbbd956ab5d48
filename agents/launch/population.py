"""Trains a population: several agents in one process that take over from each other."""

import contextlib
import functools
import math
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from megastep import engine
from megastep.agents import console, factory, package
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.errors import NonFinite, UserError, memory_problem
from megastep.agents.evaluation import in_training
from megastep.agents.factory import env_failures, settings
from megastep.agents.factory.trainer import make_trainer
from megastep.agents.launch import again, finishing, gpu, rank, signals
from megastep.agents.population import decisions
from megastep.agents.population.population import Population, Turns
from megastep.agents.runs import folders, populations, provenance
from megastep.agents.training import curves
from megastep.agents.training.progress import progress_of

if TYPE_CHECKING:
    import torch


#: Checkpoints that a member keeps at least: while one is being written, and the one before may be
#: unfinished elsewhere, all members have the one before that.
KEPT = 3


def run(cfg: settings.Train) -> Path:
    """Trains a population. Returns its folder.

    Raises:
        Interrupted: a signal came; all members were saved.
        UserError: training cannot start or continue.
    """
    device = factory.make_device(cfg.device)
    with contextlib.ExitStack() as locks:
        with contextlib.ExitStack() as undo:
            with signals.deferred():
                root, checkpoints = _open(cfg, locks)
                if not checkpoints:
                    undo.callback(shutil.rmtree, root, ignore_errors=True)
            with env_failures.told(cfg.env, root):
                population = make(cfg, root, device, checkpoints)
            folders.record_start(root)
            if cfg.device == "auto":
                gpu.warn_of_job_without()
            console.say(f"Training {cfg.population.size} members on {device} in {root}")
            undo.pop_all()
        _train(cfg, root, population)
        samples = population.samples
        console.say(table(population, root))
        del population
        best = populations.member(root)
        finishing.finish(cfg, best, samples)
        console.say(
            f"Trained {samples:,} samples of each member. The best is in {best}\n"
            f"To evaluate it: {folders.command_of('evaluate', 'run', root)}"
        )
    return root


def _open(cfg, locks) -> tuple[Path, list[Path]]:
    """Returns the population's folder, locked, and the checkpoints to resume from, if any."""
    if cfg.resume is None:
        root = folders.new(settings.run_name(cfg), cfg.folder)
        locks.enter_context(folders.locked(root))
        return root, []
    root = folders.folder_of(folders.find(cfg.resume, None))
    locks.enter_context(folders.locked(root))
    return root, populations.common_checkpoints(root)


def member_settings(cfg: settings.Train, member: int) -> settings.Train:
    """Returns the settings of a member, which are those of a run alone until it first copies."""
    seed, drawn = cfg.seed, decisions.first(cfg.seed, member, cfg.population.vary)
    for part in ("learner", "env"):
        values = {key[len(part) + 1 :]: x for key, x in drawn.items() if key.startswith(f"{part}.")}
        cfg = settings.changed(cfg, **{part: settings.changed(getattr(cfg, part), **values)})
    return settings.changed(
        cfg,
        seed=decisions.member_seed(seed, member),
        population=settings.changed(cfg.population, member=member),
        keep_checkpoints=max(KEPT, cfg.keep_checkpoints),
        folder=None,
    )


def make(
    cfg: settings.Train, root: Path, device: "torch.device", checkpoints: list[Path]
) -> Population:
    """Returns the population of a folder, new or as its checkpoints have it."""
    chosen, trainers = cfg.population, []
    turns = Turns(chosen.size, device)
    for member in range(chosen.size):
        own = member_settings(cfg, member)
        if checkpoints:
            own = again.with_more(settings.changed(own, resume=str(checkpoints[member])))
        folder = populations.folder_of(root, member)
        folder.mkdir(exist_ok=True)
        with turns.of(member):
            trainer = make_trainer(
                *(own, folder, device),
                make_evaluator=in_training.Evaluator,
                leader=trainers[0] if trainers else None,
                n_members=1 if trainers else chosen.size,
            )
        trainer.checkpoint_seconds = math.inf
        folders.write_config(folder, trainer.saver.config["train"])
        provenance.record(folder, trainer.samples, device, package.version(), package.ROOT, [])
        trainers.append(trainer)
    turns.wait()
    return Population(
        *(trainers, turns, root, cfg.seed, chosen.every, chosen.vary),
        *(chosen.exploit, chosen.explore, chosen.score, cfg.checkpoint_seconds),
    )


def _train(cfg, root, population) -> None:
    """Trains the members and turns what may happen into a sentence."""
    progress = console.Progress()
    leader = population.leader
    leader.on_log = lambda trainer: progress.show(*progress_of(trainer))
    hint = functools.partial(folders.to_continue, root)
    try:
        with (
            env_failures.told(cfg.env, root, hint),
            signals.handled(rank.announce) as numbers,
            progress,
            contextlib.closing(population),
        ):
            population.train(lambda: bool(numbers))
    except NonFiniteError as error:
        raise NonFinite(f"{error}. Earlier checkpoints are in {root}") from error
    except (MemoryError, RuntimeError) as error:
        problem = memory_problem(error)
        if not (problem or isinstance(error, engine.EngineError)):
            raise
        reason = problem or str(error).partition("\n")[0].rstrip(".")
        raise UserError(f"{reason}. {hint()}") from error
    finally:
        for trainer in population.trainers:
            curves.plot_curves(trainer.saver.folder.parent)
    if numbers:
        raise signals.Interrupted(
            numbers[0], f"Stopped after {population.samples:,} samples of each member. {hint()}"
        )
    if unsaved := next((one.saver.error for one in population.trainers if one.saver.error), None):
        raise UserError(unsaved)


def table(population: Population, root: Path) -> str:
    """Returns a table of the members: score, ancestor at the first generation, settings."""
    generations = populations.read(root / populations.FILE)
    keys = [*population.vary]
    rows = []
    for member, trainer in enumerate(population.trainers):
        score: float | None = trainer.evaluation.get("return", trainer.score)
        rows.append(
            [
                str(member),
                "" if score is None else f"{score:.4g}",
                str(populations.lineage(generations, member)[0]),
                *(f"{population.settings[member][key]:.3g}" for key in keys),
                str(population.n_diverged[member] or ""),
            ]
        )
    return console.table(["member", "return", "descends from", *keys, "diverged"], rows)
