"""Makes the trainer of a run that is new, continues, or starts from the weights of another."""

import contextlib
import functools
import random
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch

from megastep import scene, spaces
from megastep.agents import console
from megastep.agents.distributed.ranks import Ranks, world
from megastep.agents.errors import UserError, memory_problem, shortened
from megastep.agents.factory import check, conflicts, settings
from megastep.agents.factory import make as factory
from megastep.agents.generator import SeededGenerator, seed_of, stream_seed
from megastep.agents.runs import agent_file, checkpoint, folders, provenance, restore
from megastep.agents.runs.saver import Saver
from megastep.agents.training import budget, loggers
from megastep.agents.training.callbacks import Snapshots
from megastep.agents.training.trainer import Trainer
from megastep.agents.types import LearnerOptions, Row, with_defaults
from megastep.imports import import_object
from megastep.types import Env


def make_trainer(
    cfg: settings.Train,
    folder: Path,
    device: torch.device,
    token: str = "",
    *,
    ranks: Ranks | None = None,
    callbacks: Sequence[object] = (),
    make_evaluations: Callable | None = None,
    n_members: int = 1,
    homes: list[dict] | None = None,
) -> Trainer:
    """Returns a Trainer: continuing where a run stopped, or from the weights of another, if `cfg`
    says so. Each rank has one. All begin with the same weights; what else a seed decides differs.

    Args:
        token: a name that all ranks of this start have, and no other start.
        callbacks: of rank 0, before those of `cfg`.
        make_evaluations: (cfg, env, device, ranks) -> a callback that evaluates in training.
        n_members: trainers of a population that memory is to hold from this one on.
    """
    number, n_ranks = ranks = world() if ranks is None else ranks
    seed = seed_of("rank", number, cfg.seed)
    of_users = stream_seed(seed, "global")  # which only code of theirs draws from
    torch.manual_seed(of_users)
    np.random.seed(of_users % 2**32)
    random.seed(of_users)
    homes = factory.homes(cfg.env, cfg.geometry, "training") if homes is None else homes
    critic = cfg.agent.critic
    where = dict(geometries=homes, seed=seed, device=device, privileged=critic == "asymmetric")
    sample = factory.make_sample(cfg.env, **where)
    policy = factory.make_policy(cfg.agent, sample, cfg.seed, critic)
    policy.generator = SeededGenerator(stream_seed(seed, "policy"))
    learner = factory.make_learner(cfg.learner, policy, seed)
    options = with_defaults(learner, LearnerOptions)
    if cfg.learner.anneal == "auto":  # over what is limited, unless lr changes anyway
        is_free = options.set_lr is not None and not conflicts.changes_lr(cfg.learner)
        limits = [k for k in ("samples", "seconds") if is_free and getattr(cfg, k) is not None]
        own = settings.changed(cfg.learner, anneal=[*limits, "never"][0])
        cfg = settings.changed(cfg, learner=own)
    if cfg.population.size > 1 and options.copy_from is None:
        raise UserError(
            f"{type(learner).__name__} has no copy_from(other), so the members of a population "
            "cannot take over from each other: add the method, or use population.size=1"
        )
    factory.check_memory(cfg.env, sample, learner, n_members=n_members, **where)
    env = factory.construct(cfg.env, **where)
    loaded = load(cfg, policy, env, learner, device, number) if cfg.resume or cfg.init else None
    resumed = loaded if cfg.resume else None
    had: dict = (resumed and resumed.state) or Counter()
    observers = []
    if cfg.evaluation.every is not None and make_evaluations is not None:
        observers.append(make_evaluations(cfg, env, device, ranks))
    chosen, opponents = cfg.opponents, None
    if chosen.past or chosen.bot or chosen.league:
        opponents = factory.make_opponents(cfg, env, sample, policy, seed)
    if resumed and number == 0:
        for name in "checkpoints", "snapshots":
            checkpoint.set_aside_after(folder / name, resumed.step)
    config = {"train": check.as_tree(cfg), "spaces": spaces.texts(env)}
    made_with = provenance.made_with(device, n_ranks)
    with factory.errors():
        of_ranks = cfg.checkpoints.replay_every, token, number, n_ranks
        saves = Saver(folder / "checkpoints", config, cfg.checkpoints.keep, made_with, *of_ranks)
        limits = budget_of(cfg, folder, resumed)
        if number == 0:  # which alone writes these
            observers.append(budget.AnnealingRecord(folder, had["updates"]))
            observers += [make_loggers(cfg, folder, had["samples_at_report"]), *callbacks]
            if cfg.checkpoints.snapshots:
                shots = Saver(folder / "snapshots", config, keep_checkpoints=10**9)
                observers.append(Snapshots(shots, cfg.checkpoints.snapshots))
            if cfg.logging.profile:
                from megastep.agents.training.profiler import Profiler

                observers.append(Profiler(folder, cfg.logging.profile, device))
        trainer = Trainer(
            cast(Env, opponents or env),
            policy,
            learner,
            limits,
            saver=saves,
            log_every=cfg.logging.every,
            checkpoint_seconds=cfg.checkpoints.seconds,
            callbacks=[*observers, *(import_object(name)() for name in cfg.callbacks)],
            ranks=ranks,
        )
        sources = factory.sources_of(homes)
        if cfg.curriculum.name != "none":
            parts: dict = dict(env=trainer.env, learner=learner, rollout=trainer.rollout)
            trainer.curriculum = factory.construct(cfg.curriculum, sources=sources, **parts)
        if sources and not getattr(cfg.env, "resample", False):  # an environment stays in one
            is_known = cfg.env.n_envs >= len(sources) or cfg.env.name.startswith("megastep.")
            sources = scene.spread(sources, cfg.env.n_envs) if is_known else None
        trainer.episodes.begin(trainer, sources, cfg.desync)
        if resumed:
            with state_errors(resumed.path):
                trainer.run_state.load_state_dict(had, is_new_rank=number >= resumed.n_ranks)
            trainer.lost += differing(resumed.made_with, made_with)
    return trainer


def load(cfg, policy, env, learner, device, rank) -> checkpoint.Checkpoint:
    """Gives the policy the weights of the checkpoint that `cfg` names. Returns it."""
    path = folders.find(cfg.resume or cfg.init)
    loaded = folders.load_checkpoint(path, cfg.trust, device, cfg.resume is not None, rank)
    restore.load_weights(policy, loaded, env)
    if cfg.init:
        restore.load_wrappers(env, loaded, is_frozen=False)
    check_state = getattr(learner, "check_state", None)
    if cfg.resume and check_state:
        with state_errors(loaded.path):
            check_state((loaded.state or {})["learner"])  # before anything is written
    if rank == 0 and policy.critic is not None and path.suffix == agent_file.SUFFIX:
        console.say(f"{folders.name_of(path)} has no critic, so this run begins with a new one")
    return loaded


def make_loggers(cfg: settings.Train, folder: Path, step: int) -> loggers.Loggers:
    """Returns the loggers of a run that starts, resumes or ends at `step`."""
    facts = dict(folder=folder, step=step, run_name=folder.name, config=check.as_tree(cfg))
    make = functools.partial(functools.partial, factory.construct, **facts)
    return loggers.Loggers(folder, step, {label: make(one) for label, one in cfg.logger.items()})


@contextlib.contextmanager
def state_errors(path: Path) -> Iterator[None]:
    """Turns what the state of a checkpoint raises where it is restored into a UserError."""
    try:
        yield
    except Exception as error:
        if isinstance(error, RuntimeError) and memory_problem(error):
            raise
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        problem = f"{kind}{shortened(error, 300)}"
        raise UserError(f"The state in {path} is not this run's: {problem}") from error


def differing(before: Row, now: Row) -> list[str]:
    """Returns a clause for each of the things that a run's bits depend on that has changed."""
    before, now = {"ranks": 1, **before}, {"ranks": 1, **now}
    changed = {name: value for name, value in before.items() if value != now.get(name)}
    return [f"{name} was {value} and is {now.get(name)}" for name, value in changed.items()]


def budget_of(
    cfg: settings.Train, folder: Path, loaded: checkpoint.Checkpoint | None
) -> budget.Budget:
    """Returns the budget of a run, with the factors of the learning rate to be repeated."""
    recorded = ()
    if cfg.rerun:
        source = folders.folder_of(folders.find(cfg.rerun))
        if not (recorded := budget.read_record(source)):
            raise UserError(f"{source} cannot be repeated: it has no {budget.RECORD}")
    elif loaded is not None:
        recorded = budget.read_record(folder)
        # a clock of another budget would have chosen others
        if cfg.learner.anneal != "seconds" or loaded.config["train"]["seconds"] != cfg.seconds:
            assert loaded.state is not None
            recorded = recorded[: loaded.state["updates"]]
    limits = cfg.samples, cfg.seconds, cfg.learner.anneal
    return budget.Budget(*limits, recorded, cfg.rerun is not None)
