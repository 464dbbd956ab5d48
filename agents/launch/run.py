"""A run: its folder and lock, its start, training, what ends it, and what follows."""

import contextlib
import itertools
import os
import secrets
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from megastep import engine
from megastep.agents import console
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.distributed import process_group
from megastep.agents.distributed.process_group import from_rank_0, together
from megastep.agents.errors import UserError, memory_problem, user_errors
from megastep.agents.factory import components, env_failures, settings
from megastep.agents.factory import make as factory
from megastep.agents.factory.trainer import make_trainer
from megastep.agents.launch import again, signals
from megastep.agents.runs import folders, provenance
from megastep.agents.training.budget import reaches
from megastep.agents.training.callbacks import Progress
from megastep.agents.training.episode_stats import LONGEST
from megastep.agents.training.trainer import Trainer
from megastep.types import optional

if TYPE_CHECKING:
    from megastep.agents.launch.watch import Team

#: Seconds within which a file of rank 0 must be visible on the other machines.
SHARED_SECONDS = 10.0


class Run:
    """The run of an agent, in this process alone or as one of several ranks, which all do the same
    here. `PopulationRun` has what differs for a population.

    Attributes:
        folder: the run folder.
        training: what trains: the trainer, or the population.
        trainers: those of this rank.
    """

    title, of_each = "Training", ""  # of messages
    around: Callable[[], contextlib.AbstractContextManager] = contextlib.nullcontext
    folder: Path
    training: Any
    trainers: Sequence[Trainer]

    def __init__(self, cfg: settings.Train, team: "Team | None"):
        self.cfg, self.team = cfg, team
        self.is_first, self.n_ranks = process_group.rank() == 0, process_group.n_ranks()
        self.device = together(lambda: factory.make_device(cfg.device))
        self.progress = console.Progress()

    def run(self) -> Path:
        """Opens or continues the run, trains, finishes. Interrupted after a signal, once saved."""
        if self.cfg.resume == again.AUTO:
            self.cfg, ended = together(lambda: again.automatic(self.cfg))
            if ended:
                console.say(f"The run in {self.cfg.resume} has already {ended}.")
                return Path(str(self.cfg.resume))
        with contextlib.ExitStack() as locks:
            self.start(locks)
            # of a signal to all ranks, the first to get it stops them, and others get it later
            with signals.handled(lambda number: None) as numbers:
                self.train()
            if numbers:
                signals.interrupt(numbers[0])
            self.finish()
        return self.folder

    # ---- Before training ----

    def start(self, locks: contextlib.ExitStack) -> None:
        """Opens the folder, and makes what trains. If that fails, a new folder is removed."""
        is_auto = self.cfg.resume == again.AUTO
        is_new = not self.cfg.resume or (is_auto and not os.path.exists(str(self.cfg.folder)))
        with contextlib.ExitStack() as undo:
            with signals.deferred():
                self.folder, source = from_rank_0(lambda: self.open(locks))
                if self.is_first and is_new:
                    undo.callback(shutil.rmtree, self.folder, ignore_errors=True)
            token = check_shared(self.folder) if self.n_ranks > 1 else ""
            if self.team:
                self.team.set_folder(self.folder)
            caught = env_failures.caught(self.cfg.env, self.folder)
            try:
                together(caught(lambda: self.make(source, token)))
            except env_failures.EnvFailed:
                undo.pop_all()  # the folder has the traceback
                raise
            self.began()
            if self.is_first:
                folders.record_start(self.folder)
                where = f"{self.n_ranks} x {self.device.type}" if self.n_ranks > 1 else self.device
                console.say(f"{self.title} on {where} in {self.folder}")
                chosen = self.cfg.opponents
                if chosen.bot_class and not chosen.bot:
                    console.warn("opponents.bot_class plays in no environment, as opponents.bot=0")
                if chosen.role and not (chosen.past or chosen.bot or chosen.league):
                    console.warn("opponents.role has no effect without opponents.past= or bot=")
            undo.pop_all()

    def open(self, locks: contextlib.ExitStack) -> tuple[Path, Any]:
        """Returns the folder, locked, and what `make` continues from, if anything. On rank 0."""
        cfg = self.cfg
        if cfg.resume in (None, again.AUTO):
            names = [components.env_name(cfg.env), str(cfg.seed)]
            if components.takes_geometries(cfg.env.name):
                names.insert(1, components.label(cfg.geometry.name))
            folder = folders.new("-".join(names), cfg.folder, cfg.resume == again.AUTO)
            locks.enter_context(folders.locked(folder))
            return folder, None
        folder = folders.folder_of(folders.find(str(cfg.resume)))
        locks.enter_context(folders.locked(folder))
        if self.n_ranks > 1:  # all ranks from the same intact checkpoint
            return folder, str(folders.load_checkpoint(folders.find(cfg.resume), cfg.trust).path)
        return folder, cfg.resume

    def make(self, source: Any, token: str) -> None:
        """Makes what trains from what `open` returned, without waiting for other ranks."""
        self.cfg = settings.changed(self.cfg, resume=source)
        if source:
            self.cfg = again.with_more(self.cfg)
        self.training = make_trainer(
            *(self.cfg, self.folder, self.device, token),
            callbacks=[Progress(self.progress.show)],
            make_evaluations=evaluations,
        )
        self.trainers = [self.training]

    def began(self) -> None:
        """Writes what all ranks have made."""
        is_alone = self.n_ranks == 1
        hosts = [] if is_alone else process_group.gather_objects(process_group.hostname())
        lost = process_group.gather_objects(self.training.lost)
        from_rank_0(lambda: record(self.training, self.device, hosts))
        if clauses := dict.fromkeys(itertools.chain(*lost)):
            console.say(f"Resuming, but not bit for bit: {'; '.join(clauses)}.")

    # ---- Training ----

    def train(self) -> None:
        """Trains, and turns what may happen into a sentence."""
        try:
            with (
                env_failures.caught(self.cfg.env, self.folder, self.saved),
                signals.handled(signals.announce) as numbers,
                self.around(),
                self.progress.bar if self.is_first else contextlib.nullcontext(),
                contextlib.closing(self.training),
            ):
                self.training.train(lambda: bool(numbers))
        except NonFiniteError as error:
            raise UserError(f"{error}. Earlier checkpoints are in {self.folder}", 1) from error
        except (MemoryError, RuntimeError) as error:
            problem = memory_problem(error)
            if not (problem or isinstance(error, engine.EngineError)):
                raise
            reason = problem or str(error).partition("\n")[0].rstrip(".")
            raise UserError(f"{reason}. {self.saved()}") from error
        # all ranks stop if one got a signal or could not save a checkpoint
        unsaved = next((one.saver.error for one in self.trainers if one.saver.error), None)
        ends = process_group.gather_objects((numbers[:1], unsaved))
        if signal := next((numbers[0] for numbers, _ in ends if numbers), None):
            text = f"Stopped after {self.training.samples:,} samples{self.of_each}."
            raise signals.Interrupted(signal, f"{text} {folders.to_continue(self.folder)}")
        if unsaved := next((error for _, error in ends if error), None):
            raise UserError(unsaved)

    def saved(self) -> str:
        """Returns how much of a run that ended with an error is saved, and how to resume it."""
        trainer = self.training
        text = trainer.saver.error or "The latest updates could not be saved"
        text = f"All {trainer.samples:,} samples are saved" if trainer.is_saved else text
        return f"{text}. {folders.to_continue(self.folder)}"

    # ---- After training ----

    def finish(self) -> None:
        """Does what `cfg.finish` asks for, and says what came of the run."""
        from megastep.agents.launch import finishing  # with all that evaluates and films

        cfg, folder, samples, result = self.cfg, self.folder, self.training.samples, self.result()
        nonfinite = self.training.nonfinite_guard.value
        del self.training, self.trainers  # frees GPU memory for the evaluation
        finishing.finish(cfg, folder, samples)
        if nonfinite and nonfinite.is_from_env:
            raise UserError(f"{nonfinite}. All other rollouts were used; the run is in {folder}", 1)
        if cfg.rerun and self.is_first:
            finishing.compare(folder, Path(cfg.rerun))
        console.say(f"{result}. The run is in {folder}\n{finishing.next_command(cfg, folder)}")

    def result(self) -> str:
        """Returns what a run came to: samples, seconds, and the return of its last episodes."""
        trainer, stop = self.training, self.cfg.evaluation.stop
        text = f"Trained {trainer.samples:,} samples in {console.duration(trainer.clock.seconds)}"
        if reaches(trainer.evaluation, stop):
            goals = ", ".join(
                f"{name} {trainer.evaluation[name]:.4g} (evaluation.stop.{name}={goal:g})"
                for name, goal in stop.items()
            )
            return f"{text}, when an evaluation had {goals}"
        latest = trainer.latest_stats
        if "episode/return" not in latest:
            return f"{text}; {self.too_short()}"
        n = f"{latest['episode/window']:,.0f}"
        return f"{text}; mean return {latest['episode/return']:.4g} of the last {n} episodes"

    def too_short(self) -> str:
        """Returns why a run has no mean return, and how long it has to be for one."""
        trainer = self.training
        n_lanes = trainer.rollout.n_lanes * trainer.ranks.n
        n_steps = each = trainer.samples // n_lanes
        running = int(trainer.episodes.stats.totals[1].max())
        why = f"an episode has more than {running} steps"
        most = getattr(trainer.env, "limit", None) or optional(trainer.env, "max_episode_steps")
        if isinstance(most, int) and each < most < LONGEST:
            why, n_steps = f"an episode has up to {most} steps", most
        elif running < each:
            why = "not all episodes that began before the last report have ended"
        return (  # twice as many, since the first episodes begin at random ages
            f"no mean return yet: {why}, and each of {n_lanes} lanes took {each}; give "
            f"samples={2 * n_steps * n_lanes}, or more seconds="
        )


def evaluations(*arguments: Any) -> Any:
    """Returns `Evaluations`, for `make_trainer`."""
    from megastep.agents.evaluation import in_training  # with all that evaluates

    return in_training.Evaluations(*arguments)


def record(trainer: Trainer, device: Any, hosts: Sequence[str] = ()) -> None:
    """Writes the settings of an agent that starts to train, and a line about where it does."""
    folder, config = trainer.saver.folder.parent, trainer.saver.config["train"]
    text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
    folders.write({folder / "config.yaml": text})
    provenance.record(folder, trainer.samples, device, hosts)


def check_shared(folder: Path) -> str:
    """UserError on all ranks if one does not see the folder. Returns a name of this start."""
    name = from_rank_0(secrets.token_hex)
    path = folder / f".ranks-{name}"

    def wait_for_file() -> None:
        deadline = time.monotonic() + SHARED_SECONDS
        while not (folder.is_dir() and path.name in os.listdir(folder)):
            if time.monotonic() > deadline:
                raise UserError(
                    f"The run folder {folder.absolute()} of rank 0 is not here; start all ranks "
                    "in one folder that their machines share, or give folder= with a path there"
                )
            time.sleep(0.1)

    with user_errors(folders.CANNOT.format(folder)):
        from_rank_0(path.touch)
    try:
        together(wait_for_file)
    finally:
        if process_group.rank() == 0:
            path.unlink(missing_ok=True)
    return name
