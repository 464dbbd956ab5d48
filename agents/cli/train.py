"""Trains a policy. `train --help` lists what can be chosen; `run(cfg)` is the same from
Python.
"""

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path

import torch

from megastep import engine
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.cli import evaluate, factory, record, run_folders
from megastep.agents.cli.build import as_tree
from megastep.agents.cli.command import Script, run_command
from megastep.agents.cli.console import Progress, duration, number, say, warn
from megastep.agents.cli.errors import ConfigErrors, NotFinite, UserError
from megastep.agents.cli.lock import locked
from megastep.agents.cli.settings import Evaluate, Record, Train, WandbLogger
from megastep.agents.cli.signals import Interrupted, Interruptions
from megastep.agents.training import checkpoint, curves, loggers
from megastep.agents.training.budget import Budget
from megastep.agents.training.saver import Saver, SnapshotSaver
from megastep.agents.training.trainer import Trainer

HELP = """Trains a policy in an environment.

The commonest:
  experiment=quickstart          the recipe of `make train`: train, evaluate on unseen homes, film
  env=minimal geometry=box     another environment, other homes
  seconds=60 samples=1e6       when to stop, whichever comes first; Ctrl-C stops too, and saves
  preset=gpu env.n_envs=256    the sizes for a GPU, or your own
  learner.lr=3e-4 seed=2       any key that --cfg job prints
  learner=vtrace               instead of ppo: learner.lag=1 acts while it learns,
                               learner.buffer=replay learns from old experience, too
  finish.evaluate=true finish.record=true
                               a table and a video at the end
  opponents.past=0.4 opponents.bot=0.1
                               of environments with several agents, shares against past selves and
                               a scripted policy; snapshots=8 keeps what ratings compare
  resume=RUN                   continue a run (its folder, or latest) under its own configuration
  init=RUN                     start a new run from its weights, in its environment
  env=my_package.rover:Rover   a class of your own; so too geometry, learner, agent.core
  logger=wandb logger.mode=offline"""
#: Metrics and groups of lanes that are shown beside the return.
FEW = 4
#: Before the kind of opponent, the share of pairs won.
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
    cfg: Train, folder: Path, device: torch.device, on_report: Callable[[Trainer], None]
) -> tuple[Trainer, Saver]:
    """A Trainer as `cfg` describes it, and its Saver: going on where a run stopped, or from the
    weights of another, if `cfg` says so.
    """
    homes = factory.homes(cfg.env, cfg.geometry, "training")
    wanted = cfg.env, homes, cfg.seed, device, cfg.agent.critic == "asymmetric"
    sample = factory.make_sample(*wanted)
    policy = factory.make_policy(cfg.agent, sample, cfg.seed)
    learner = factory.make_learner(cfg.learner, policy, cfg.seed)
    replayed = factory.replay_bytes(learner, sample) / cfg.env.n_envs
    beside = learner.bytes_per_env(sample) + replayed
    env = factory.make_env(*wanted, sample, bytes_beside=beside)
    loaded = None
    if cfg.resume or cfg.init:
        loaded = factory.load_checkpoint(run_folders.find(cfg.resume or cfg.init), device)
        factory.load_weights(policy, env, loaded)
    opponents = factory.make_opponents(cfg, env, sample, policy)
    wandb = None
    if isinstance(cfg.logger, WandbLogger):
        given = {key: getattr(cfg.logger, key) for key in ("project", "mode", "group")}
        wandb = dict(given, name=folder.name, config=as_tree(cfg))
    if cfg.resume:
        for name in ("checkpoints", "snapshots"):
            checkpoint.set_aside_after(folder / name, loaded.step)
    with factory.errors():
        sinks = loggers.Loggers(folder, loaded.step if cfg.resume else 0, wandb)
    config = {"train": as_tree(cfg), "spaces": factory.spaces_of(env)}
    saver = Saver(folder / "checkpoints", config, cfg.keep_checkpoints)
    snapshots = Saver(folder / "snapshots", config, keep_checkpoints=10**9)
    with factory.errors():
        trainer = Trainer(
            opponents or env,
            policy,
            learner,
            sinks,
            saver,
            Budget(cfg.samples, cfg.seconds, cfg.learner.anneal),
            log_every=cfg.log_every,
            checkpoint_seconds=cfg.checkpoint_seconds,
            on_log=on_report,
            opponents=opponents,
            snapshot_saver=SnapshotSaver(snapshots, cfg.snapshots),
        )
    if cfg.resume:
        with factory.errors():
            trainer.load_state_dict(loaded.state)
    return trainer, saver


def show(progress: Progress, trainer: Trainer) -> None:
    """Shows the few numbers that people watch."""
    words = [f"{number(trainer.samples)} samples"]
    if trainer.samples_per_second is not None:
        words.append(f"{number(trainer.samples_per_second)}/s")
    if trainer.score is not None:
        words.append(f"return {trainer.score:.2f}")
        words += few_means(
            trainer.latest_stats, trainer.episode_stats.metrics, trainer.episode_stats.groups
        )
        won = {
            k.rpartition("/")[2]: v for k, v in trainer.latest_stats.items() if k.startswith(WON)
        }
        words += [f"{share:.2f} won against {kind}" for kind, share in won.items()]
    left = trainer.fraction_left
    if trainer.budget.is_limited and left < 1:
        words.append(f"{duration(trainer.clock.seconds * left / (1 - left))} left")
    progress.show(1 - left if trainer.budget.is_limited else None, "  ".join(words))


def few_means(latest: dict[str, float], metrics: Sequence[str], groups: Sequence[str]) -> list[str]:
    """Returns by group of lanes, and metrics, as text, where they are few enough for one line."""
    by_group = {group: f"episode/return/{group}" for group in groups}
    names = {**by_group, **{name: f"episode/{name}" for name in metrics}}
    if len(names) > FEW:
        return []
    return [f"{name} {latest[key]:.3g}" for name, key in names.items() if key in latest]


def settled(cfg: Train) -> Train:
    """`cfg` with learner.anneal=auto replaced by what it stands for: samples if they are limited,
    else seconds, else never.
    """
    if cfg.learner.anneal != "auto":
        return cfg
    limited = [name for name in ("samples", "seconds") if getattr(cfg, name) is not None]
    anneal = [*limited, "never"][0]
    return dataclasses.replace(cfg, learner=dataclasses.replace(cfg.learner, anneal=anneal))


def run(cfg: Train) -> Path:
    """Trains as `cfg`, a settings.Train, says. Returns the run folder; after a signal, saves and
    raises Interrupted.
    """
    cfg = settled(cfg)
    device = factory.make_device(cfg.device)
    folder = (
        run_folders.folder_of(run_folders.find(cfg.resume)) if cfg.resume else run_folders.new(cfg)
    )
    with locked(folder), run_folders.inside(folder):
        progress = Progress()
        with nullcontext() if cfg.resume else run_folders.cleanup_on_error(folder):
            trainer, saver = make_trainer(cfg, folder, device, partial(show, progress))
            run_folders.write_config(folder, cfg)
        run_folders.record_start(folder)
        say(f"Training on {device} in {folder}")
        resume = f"To go on: {run_folders.resume_command(folder)}"
        try:
            with Interruptions() as stop, progress, closing(trainer.logger):
                trainer.train(lambda: stop.number is not None)
        except NonFiniteError as error:
            raise NotFinite(f"{error}. What was saved before is in {folder}") from error
        except (engine.EngineError, torch.OutOfMemoryError) as error:
            reason = str(error).splitlines()[0].rstrip(".")
            saved = saver.error or "What was learnt last could not be saved"
            if trainer.is_saved:
                saved = f"All {trainer.samples:,} samples are saved"
            raise UserError(f"{reason}. {saved}. {resume}") from error
        finally:
            curves.plot_curves(folder)
        if stop.number is not None:
            raise Interrupted(stop.number, f"Stopped after {trainer.samples:,} samples. {resume}")
        if saver.error:
            raise UserError(saver.error)
        nonfinite_value = trainer.nonfinite_value
        del trainer  # its memory is the evaluation's now
        finish(cfg, folder)
        if nonfinite_value and nonfinite_value.is_from_env:
            raise NotFinite(f"{nonfinite_value}. All else was learnt from, and is in {folder}")
    return folder


def finish(cfg: Train, folder: Path) -> None:
    """What the run leaves behind beside its checkpoints: a table and a video, if asked for."""
    common = dict(
        run=str(folder), geometry=None, split="test", greedy=False, seed=cfg.seed, device=cfg.device
    )
    if cfg.finish.evaluate:
        evaluate.run(Evaluate(episodes=cfg.finish.episodes, baseline=True, **common))
    if cfg.finish.record:
        try:
            record.run(Record(steps=cfg.finish.steps, home=0, file=None, **common))
        except UserError as error:
            warn(str(error))


def prepared(tree: dict, given: list[str]) -> dict:
    """The tree of a run that goes on, or that starts from the weights of another; that of any
    other is as it was. `given` are the keys that were typed.
    """
    resume, init = tree.get("resume"), tree.get("init")
    if isinstance(resume, str) and init is None:
        return _resumed(tree, given)
    if isinstance(init, str) and resume is None:
        return _initialised(tree, given)
    return tree


def _initialised(tree, given):
    """The environment and the agent are those of the run that the weights are from, but for the
    keys that are given; a group that is given whole is as it was.
    """
    own = factory.load_checkpoint(run_folders.find(tree["init"])).config["train"]
    for group in ("env", "agent"):
        if group not in given:
            keys = [key.split(".", 1)[1] for key in given if key.startswith(f"{group}.")]
            tree[group] = own[group] | {key: tree[group][key] for key in keys}
    return tree


def _resumed(tree, given):
    """The run's own tree, but for what may change."""
    if refused := [
        (key, "cannot change when a run goes on; init=RUN starts a new one from its weights")
        for key in given
        if key.split(".")[0] not in RESUMABLE
    ]:
        raise ConfigErrors(refused)
    loaded = factory.load_checkpoint(run_folders.find(tree["resume"]))
    if "learner" not in loaded.state:
        raise UserError(
            f"{loaded.path} is a snapshot, the weights alone; init={loaded.path} starts a new run "
            "from it, and the run's folder goes on"
        )
    own = loaded.config["train"]
    for path in given:
        *groups, key = path.split(".")
        target, source = own, tree
        for group in groups:
            target, source = target[group], source[group]
        target[key] = source[key]
    had = {name: loaded.state[name] for name in ("samples", "seconds")}
    if spent := [
        (name, f"the run has had {round(n, 1):,} of {own[name]:,}; to go on, give {name}= more")
        for name, n in had.items()
        if own[name] is not None and n >= own[name]
    ]:
        raise ConfigErrors(spent)
    return {**own, "init": None}


def main(argv: list[str] | None = None) -> int:
    return run_command(Script("train", Train, run, HELP, prepared), argv)
