"""Trains a policy. `python train.py --help` lists what can be chosen; `run(cfg)` is the same from
Python.
"""

import shutil
import time
from contextlib import nullcontext

import torch

from agents import checkpoint, metrics
from agents.cli import components, evaluate, record, run_folders
from agents.cli.build import as_tree
from agents.cli.command import run_command
from agents.cli.console import Progress, duration, number, say, warn
from agents.cli.errors import ConfigErrors, UserError
from agents.cli.settings import Evaluate, Record, Train, WandbLogger
from agents.cli.signals import Interrupted, Interruptions
from agents.rollout import collect, initial_actor_state
from megastep import capture, engine

HELP = """Trains a policy in an environment.

The commonest:
  experiment=newcomer          the recipe of `make train`: train, evaluate on unseen homes, film
  env=minimal geometry=box     another environment, other homes
  seconds=60 samples=1e6       when to stop, whichever comes first; Ctrl-C stops too, and saves
  preset=gpu env.n_envs=256    the sizes for a GPU, or your own
  learner.lr=3e-4 seed=2       any key that --cfg job prints
  finish.evaluate=true finish.record=true
                               a table and a video at the end
  resume=RUN                   continue a run (its folder, or latest) under its own configuration
  init=RUN                     start a new run from its weights
  logger=wandb logger.mode=offline"""
#: What may change when a run is resumed: where it runs, when it stops, what it leaves behind; never
#: what it learns.
RESUMABLE = (
    "resume",
    "samples",
    "seconds",
    "device",
    "report",
    "checkpoint",
    "keep",
    "logger",
    "finish",
)


class Trainer:
    """All that one run trains with, and how far it has come."""

    def __init__(self, cfg, folder, device):
        self.cfg, self.folder = cfg, folder
        homes = components.homes(cfg.geometry, "training")
        self.env = components.make_env(
            cfg.env, homes, cfg.seed, device, lambda env: components.rollout_bytes(cfg, env)
        )
        self.policy = components.make_policy(cfg.agent, self.env, cfg.seed)
        self.learner = components.make_learner(cfg.learner, self.policy, cfg.seed)
        self.rollout = components.make_rollout(cfg, self.env)
        self.episodes = metrics.Episodes(self.rollout.n_lanes, device)
        self.samples = self.updates = 0  # environment steps of all lanes; rollouts learnt from
        self.seconds = 0.0  # of training, from the end of the first update on
        if cfg.resume:
            self.restore(components.load(run_folders.find(cfg.resume), device))
        elif cfg.init:
            components.load_weights(
                self.policy, self.env, components.load(run_folders.find(cfg.init), device)
            )
        wandb = None
        if isinstance(cfg.logger, WandbLogger):
            project, mode = cfg.logger.project, cfg.logger.mode
            wandb = dict(project=project, mode=mode, name=folder.name, config=as_tree(cfg))
        self.metrics = metrics.Metrics(folder, self.samples, wandb)
        self.reported = self.samples, time.monotonic()
        self.score = self.unsaved = (
            None  # the last reported return; why the last checkpoint is missing
        )

    def train(self, stop):
        """Collects, updates, reports, saves, until the budget is spent or `stop.number` is set."""
        actor_state = initial_actor_state(self.env, self.policy)
        self.started = self.saved = None
        with Progress() as progress:
            while self.left() > 0 and stop.number is None:
                self.collect(actor_state)
                if self.cfg.learner.anneal:
                    self.learner.set_lr(self.cfg.learner.lr * max(0.0, self.left()))
                losses = self.learner.update(self.rollout)
                self.count()
                if self.updates % self.cfg.report == 0:
                    self.report(losses, progress)
                if self.now() - self.saved >= self.cfg.checkpoint:
                    self.save()
        self.save()
        self.metrics.close()

    def collect(self, actor_state):
        """Fills the rollout. On a GPU from the second time on as a CUDA graph, which replaces this
        method.
        """
        parts = self.env, self.policy, self.rollout, actor_state
        if self.env.device.type == "cuda" and self.updates:
            self.policy.random.on(self.env.device)
            graph = capture.capture(lambda: collect(*parts), (), parts)
            self.collect = lambda actor_state: graph()
            return graph()
        collect(*parts)

    def count(self):
        rollout = self.rollout
        self.episodes.add(rollout.reward, rollout.reset, rollout.terminal | rollout.truncated)
        self.samples += rollout.n_steps * rollout.n_lanes
        self.updates += 1
        if self.started is None:
            if self.env.device.type == "cuda":
                torch.cuda.synchronize(self.env.device)
            self.started = time.monotonic() - self.seconds
            self.saved = self.seconds
            self.reported = self.samples, self.started + self.seconds

    def now(self):
        """Seconds of training so far, those before a resume included."""
        return self.seconds if self.started is None else time.monotonic() - self.started

    def left(self):
        """The fraction of the budget that is left; without a budget, all of it."""
        spent = [
            done / budget
            for done, budget in ((self.samples, self.cfg.samples), (self.now(), self.cfg.seconds))
            if budget is not None
        ]
        return 1 - max(spent, default=0)

    def report(self, losses, progress):
        """Writes the metrics since the last report, and shows the few that people watch. Waits for
        the device.
        """
        names, values = zip(*losses.items())
        if hasattr(self.env, "core"):
            engine.check(self.env.core.agents)
        found = {
            **self.episodes.take(),
            **dict(zip(names, torch.stack(values).tolist())),
            "updates": self.updates,
        }
        samples, then = self.reported
        self.reported = self.samples, time.monotonic()
        perf = {"perf/seconds": self.now()}
        words = [f"{number(self.samples)} samples"]
        if self.samples > samples:  # the first update, which compiles, says nothing of the rate
            perf["perf/rate"] = (self.samples - samples) / (self.reported[1] - then)
            words.append(f"{number(perf['perf/rate'])}/s")
        self.metrics.write(self.samples, found, perf)
        self.score = found.get("episode/return", self.score)
        if self.score is not None:
            words.append(f"return {self.score:.2f}")
        left, limited = self.left(), self.cfg.samples is not None or self.cfg.seconds is not None
        if limited and left < 1:
            words.append(f"{duration(self.now() * left / (1 - left))} left")
        progress.show(1 - left if limited else None, "  ".join(words))

    def save(self):
        """Writes a checkpoint; on a full disk warns once, and the next interval tries again."""
        self.saved = self.now()
        try:
            config = {"train": as_tree(self.cfg), "spaces": components.spaces_of(self.env)}
            checkpoint.save(
                self.folder / "checkpoints",
                self.samples,
                self.state(),
                config,
                self.cfg.keep,
                self.score,
            )
            self.unsaved = None
        except OSError as error:
            needed = 3 * sum(
                p.numel() * p.element_size() for p in self.policy.parameters()
            )  # Adam's two as well
            free = shutil.disk_usage(self.folder).free
            again, self.unsaved = (
                self.unsaved,
                (
                    f"The checkpoint at {self.samples:,} samples could not be saved "
                    f"({error.strerror}): it needs about "
                    f"{needed / 1e6:.1f} MB, and {free / 1e6:.1f} MB are free in {self.folder}"
                ),
            )
            if not again:
                warn(
                    f"{self.unsaved}; training goes on and tries again in "
                    f"{self.cfg.checkpoint:.0f} s"
                )

    def state(self):
        """All that a checkpoint holds, as plain dicts of tensors and numbers."""
        parts = {
            name: getattr(self, name).state_dict() for name in ("policy", "learner", "episodes")
        }
        return dict(**parts, samples=self.samples, updates=self.updates, seconds=self.now())

    def restore(self, loaded):
        state = loaded.state
        components.load_weights(self.policy, self.env, loaded)
        self.learner.load_state_dict(state["learner"])
        self.episodes.load_state_dict(state["episodes"])
        self.samples, self.updates, self.seconds = (
            state["samples"],
            state["updates"],
            state["seconds"],
        )


def run(cfg):
    """Trains as `cfg`, a settings.Train, says. Returns the run folder; after a signal, saves and
    raises Interrupted.
    """
    device = components.make_device(cfg.device)
    folder = (
        run_folders.folder_of(run_folders.find(cfg.resume)) if cfg.resume else run_folders.new(cfg)
    )
    with Interruptions() as stop:
        with nullcontext() if cfg.resume else run_folders.cleanup_on_error(folder):
            trainer = Trainer(cfg, folder, device)
            run_folders.write_config(folder, cfg)
        say(f"Training on {device} in {folder}")
        try:
            trainer.train(stop)
        except (engine.EngineError, torch.OutOfMemoryError) as error:
            reason = str(error).splitlines()[0].rstrip(".")
            raise UserError(f"{reason}. What was saved before it is in {folder}") from error
        metrics.curves(folder)
        if stop.number is not None:
            raise Interrupted(
                stop.number,
                f"Stopped after {trainer.samples:,} samples. "
                f"To go on: python train.py resume={folder}",
            )
    if trainer.unsaved:
        raise UserError(trainer.unsaved)
    del trainer  # its memory is the evaluation's now
    finish(cfg, folder)
    return folder


def finish(cfg, folder):
    """What the run leaves behind beside its checkpoints: a table and a video, if asked for."""
    common = dict(
        run=str(folder), geometry=None, split="test", greedy=False, seed=cfg.seed, device=cfg.device
    )
    if cfg.finish.evaluate:
        evaluate.run(Evaluate(lanes=cfg.finish.lanes, baseline=True, **common))
    if cfg.finish.record:
        try:
            record.run(Record(steps=cfg.finish.steps, home=0, file=None, **common))
        except UserError as error:
            warn(str(error))


def resumed(tree, overrides):
    """The tree of a run that goes on: its own, but for what `overrides` may change. That of a new
    run is as it was.
    """
    if tree["resume"] is None:
        return tree
    given = [word.split("=", 1)[0] for word in overrides]
    if refused := [
        (key, "cannot change when a run goes on; init=RUN starts a new one from its weights")
        for key in given
        if key.split(".")[0] not in RESUMABLE
    ]:
        raise ConfigErrors(refused)
    own = components.load(run_folders.find(tree["resume"])).config["train"]
    for path in given:
        *groups, key = path.split(".")
        target, source = own, tree
        for group in groups:
            target, source = target[group], source[group]
        target[key] = source[key]
    return {**own, "init": None}


def main(argv=None):
    return run_command("train", Train, run, HELP, argv, resumed)
