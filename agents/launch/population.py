"""Trains a population: several agents in one process that take over from each other."""

import contextlib
import functools
import gc
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from megastep import engine
from megastep.agents import console, factory, package
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.distributed import environment, process_group
from megastep.agents.distributed.agreement import from_rank_0, together
from megastep.agents.distributed.pooling import alone
from megastep.agents.distributed.ranks import ONE
from megastep.agents.errors import ConfigErrors, EnvFailed, NonFinite, UserError, memory_problem
from megastep.agents.evaluation import in_training
from megastep.agents.factory import env_failures, settings
from megastep.agents.factory.trainer import make_trainer
from megastep.agents.launch import again, compare, finishing, gpu, rank_checks, signals
from megastep.agents.launch.watch import Team
from megastep.agents.population import decisions
from megastep.agents.population.population import AgentParts, Population, Streams, hosted
from megastep.agents.runs import folders, populations, provenance
from megastep.agents.training import curves
from megastep.agents.training.callbacks import Progress
from megastep.settings import closest

if TYPE_CHECKING:
    import torch

    from megastep.agents.training.trainer import Trainer

#: Checkpoints that a member keeps at least: while one is being written, and the one before may be
#: unfinished elsewhere, all members have the one before that.
KEPT = 3


def run(cfg: settings.Train, team: Team | None = None) -> Path:
    """Trains a population, of which each rank of a team hosts a part. Returns its folder.

    Raises:
        Interrupted: a signal came; all members were saved.
        UserError: training cannot start or continue.
    """
    is_first, n_ranks = process_group.rank() == 0, process_group.n_ranks()
    device = together(lambda: factory.make_device(cfg.device, process_group.local_rank()))
    rank_checks.check_start(cfg)
    cfg = rank_checks.started_again(cfg, team)
    if n_ranks > cfg.population.size:
        problem = f"{n_ranks} is more than the members of the population"
        raise ConfigErrors([("ranks", f"{problem}; use population.size={n_ranks} or more")])
    with contextlib.ExitStack() as locks:
        with contextlib.ExitStack() as undo:
            with signals.deferred():
                root, checkpoints = from_rank_0(lambda: _open(cfg, locks))
                if is_first and not checkpoints:
                    undo.callback(shutil.rmtree, root, ignore_errors=True)
            rank_checks.check_shared(root)
            if team:
                team.set_folder(root)
            told = env_failures.told(cfg.env, root, rank=environment.rank())
            try:
                with alone():
                    population = together(told(lambda: make(cfg, root, device, checkpoints)))
            except EnvFailed:
                undo.pop_all()  # the folder has the traceback
                raise
            if is_first:
                folders.record_start(root)
                if cfg.device == "auto":
                    gpu.warn_of_job_without()
                ranks = f"{n_ranks} x {device.type}" if n_ranks > 1 else device
                console.say(f"Training {cfg.population.size} members on {ranks} in {root}")
            undo.pop_all()
        with alone():
            _train(cfg, root, population)
        samples, text = population.samples, table(population, root)
        del population
        best = from_rank_0(lambda: populations.member(root))
        if is_first:
            console.say(text)
        finishing.finish(cfg, best, samples)
        if is_first:
            if cfg.rerun:
                compare.population(root, Path(cfg.rerun))
            console.say(
                f"Trained {samples:,} samples of each member. The best is in {best}\n"
                f"To evaluate it: {folders.command_of('evaluate', 'run', root)}"
            )
        process_group.exchange([0])  # the others wait for what follows on rank 0
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
    rerun = cfg.rerun and str(populations.folder_of(Path(cfg.rerun), member))
    return settings.changed(
        cfg,
        seed=decisions.member_seed(seed, member),
        rerun=rerun,
        population=settings.changed(cfg.population, member=member),
        keep_checkpoints=max(KEPT, cfg.checkpoints.keep),
        folder=None,
    )


def make(
    cfg: settings.Train, root: Path, device: "torch.device", checkpoints: list[Path]
) -> Population:
    """Returns the population of a folder, new or as its checkpoints have it: the members of this
    rank.
    """
    chosen, trainers, members = cfg.population, [], hosted(cfg.population.size)
    streams, homes = Streams(len(members), device), None
    if cfg.geometry.name.startswith("megastep."):  # another's may draw from global generators
        homes = factory.homes(cfg.env, cfg.geometry, "training")
    for i, member in enumerate(members):
        own = member_settings(cfg, member)
        if checkpoints:
            own = again.with_more(settings.changed(own, resume=str(checkpoints[member])))
        folder = populations.folder_of(root, member)
        folder.mkdir(exist_ok=True)
        with streams.of(i):
            trainer = make_trainer(
                *(own, folder, device),
                make_evaluator=in_training.Evaluator,
                n_members=1 if trainers else len(members),
                homes=homes,
                ranks=ONE,
            )
        check_score(chosen.score, trainer)
        folders.write_config(folder, trainer.saver.config["train"])
        provenance.record(folder, trainer.samples, device, package.version(), package.ROOT, [])
        trainers.append(trainer)
    streams.wait()
    repeated = None
    if cfg.rerun:
        repeated = populations.samples_of_generations(Path(cfg.rerun) / populations.FILE)
    visitor = None
    if len(members) < chosen.size:
        env = trainers[0].env
        policy = factory.make_policy(cfg.agent, env, cfg.seed, cfg.agent.critic)
        visitor = AgentParts(policy, factory.make_learner(cfg.learner, policy, cfg.seed))
    return Population(
        *(trainers, streams, root, cfg.seed, chosen.every, chosen.vary),
        *(chosen.exploit, chosen.explore, chosen.score, cfg.checkpoints.seconds),
        *(chosen.size, visitor, repeated),
    )


def check_score(score: str, trainer: "Trainer") -> None:
    """Raises ConfigErrors if a trainer's reports have nothing of this name."""
    known = [populations.RUNNING, populations.EVALUATED, *trainer.episodes.names]
    if score not in known:
        text = f"{score} is no mean over episodes here; {closest(score, known)}"
        raise ConfigErrors([("population.score", text)])


def _train(cfg, root, population) -> None:
    """Trains the members and turns what may happen into a sentence."""
    progress = console.Progress()
    if population.rank == 0:
        population.leader.callbacks.insert(-1, Progress(progress.show))
    hint = functools.partial(folders.to_continue, root)
    try:
        with (
            env_failures.told(cfg.env, root, hint, population.rank),
            signals.handled() as numbers,
            engine.without_early_starts(),
            _without_garbage(),
            progress if population.rank == 0 else contextlib.nullcontext(),
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
        with process_group.unhurried():
            for trainer in population.trainers:
                curves.plot_curves(trainer.saver.folder.parent)
    unsaved = next((one.saver.error for one in population.trainers if one.saver.error), None)
    ends = process_group.gather_objects((numbers[:1], unsaved))
    if signal := next((numbers[0] for numbers, _ in ends if numbers), None):
        raise signals.Interrupted(
            signal, f"Stopped after {population.samples:,} samples of each member. {hint()}"
        )
    if unsaved := next((error for _, error in ends if error), None):
        raise UserError(unsaved)


@contextlib.contextmanager
def _without_garbage() -> Iterator[None]:
    """What there is now is not looked through for garbage inside, as each recording of a CUDA graph
    does: of many members, that would take longer than the recording.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def table(population: Population, root: Path) -> str:
    """Returns a table of the members: the score by which commands find the best, ancestor at the
    first generation, settings. All ranks call it, once all members have written their metrics.
    """
    folders = [trainer.saver.folder.parent for trainer in population.trainers]
    scores = population.gathered(
        [populations.score_of(folder, population.score) for folder in folders]
    )
    generations = populations.read(root / populations.FILE)
    keys = [*population.vary]
    rows = []
    for member, score in enumerate(scores):
        rows.append(
            [
                str(member),
                "" if score is None else f"{score:.4g}",
                str(populations.lineage(generations, member)[0]),
                *(f"{population.settings[member][key]:.3g}" for key in keys),
                str(population.n_diverged[member] or ""),
            ]
        )
    is_return = population.score in (populations.RUNNING, populations.EVALUATED)
    title = "return" if is_return else population.score
    return console.table(["member", title, "descends from", *keys, "diverged"], rows)
