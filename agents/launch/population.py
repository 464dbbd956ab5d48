"""The run of a population: several agents in one process that take over from each other."""

import contextlib
import gc
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from megastep import engine
from megastep.agents import console
from megastep.agents.distributed import process_group
from megastep.agents.distributed.pooling import alone
from megastep.agents.distributed.process_group import from_rank_0
from megastep.agents.distributed.ranks import ONE
from megastep.agents.errors import ConfigErrors
from megastep.agents.factory import make as factory
from megastep.agents.factory import settings
from megastep.agents.factory.trainer import make_trainer
from megastep.agents.generator import seed_of
from megastep.agents.launch import again, finishing
from megastep.agents.launch.run import Run, evaluations, record
from megastep.agents.population import decisions
from megastep.agents.population.population import AgentParts, Population, Streams, hosted
from megastep.agents.runs import checkpoint, folders, populations
from megastep.agents.training.callbacks import Progress
from megastep.agents.training.episode_stats import MIN_EPISODES
from megastep.settings import closest

#: Checkpoints that a member keeps at least: while one is being written, and the one before may be
#: unfinished elsewhere, all members have the one before that.
KEPT = 3
UNSCORED = (
    f"No member had a score when others could copy it, as fewer than {MIN_EPISODES} of its "
    "episodes had ended or it had not been evaluated, so nobody was copied; train longer."
)


class PopulationRun(Run):
    """The run of a population, of which each rank trains a part."""

    of_each = " of each member"
    training: Population

    def open(self, locks: contextlib.ExitStack) -> tuple[Path, Any]:
        self.title = f"Training {(size := self.cfg.population.size)} members"
        if (n := self.n_ranks) > size:
            text = f"{n} is more than the {size} members of the population"
            raise ConfigErrors([("ranks", f"{text}; use population.size={n} or more")])
        if self.cfg.resume is None:
            return super().open(locks)
        root = folders.folder_of(folders.find(self.cfg.resume, None))
        locks.enter_context(folders.locked(root))
        return root, populations.common_checkpoints(root)

    def make(self, source: Any, token: str) -> None:
        """Makes the members of this rank, new or as their checkpoints have them."""
        cfg, chosen, self.trainers = self.cfg, self.cfg.population, []
        members, is_new = hosted(chosen.size), not source
        if cfg.resume and is_new:
            console.say("Not all members have a checkpoint yet, so all begin again")
            totals = {
                k: getattr(cfg, f"more_{k}") or getattr(cfg, k) for k in ("samples", "seconds")
            }
            cfg = settings.changed(cfg, resume=None, more_samples=None, more_seconds=None, **totals)
        self.streams, homes = Streams(len(members), self.device), None
        if cfg.geometry.name.startswith("megastep."):  # another's may draw from global generators
            homes = factory.homes(cfg.env, cfg.geometry, "training")
        for i, member in enumerate(members):
            own = member_settings(cfg, member)
            if not is_new:
                own = again.with_more(settings.changed(own, resume=str(source[member])))
            folder = populations.folder_of(self.folder, member)
            folder.mkdir(exist_ok=True)
            if is_new:  # what a kill left of the first checkpoint
                checkpoint.set_aside_after(folder / "checkpoints", -1)
            with self.streams.of(i), alone():
                trainer = make_trainer(
                    *(own, folder, self.device),
                    ranks=ONE,
                    callbacks=[Progress(self.progress.show)] if member == 0 else (),
                    make_evaluations=evaluations,
                    n_members=1 if self.trainers else len(members),
                    homes=homes,
                )
            known = [populations.RUNNING, populations.EVALUATED, *trainer.episodes.names]
            if (score := chosen.score) not in known:
                text = f"{score} is not a mean over episodes here; {closest(score, known)}"
                raise ConfigErrors([("population.score", text)])
            record(trainer, self.device)
            self.trainers.append(trainer)
        self.streams.wait()

    def began(self) -> None:
        """Makes the population of the members of all ranks."""
        cfg, chosen, repeated, visitor = self.cfg, self.cfg.population, None, None
        if cfg.rerun:
            generations = populations.read(Path(cfg.rerun) / populations.FILE)
            repeated = {rows[0]["samples"] for rows in generations[1:]}
        if len(self.trainers) < chosen.size:
            env = self.trainers[0].env
            policy = factory.make_policy(cfg.agent, env, cfg.seed, cfg.agent.critic)
            visitor = AgentParts(policy, factory.make_learner(cfg.learner, policy, cfg.seed))
        self.training = Population(
            *(self.trainers, self.streams, self.folder, cfg.seed, chosen),
            *(cfg.checkpoints.seconds, visitor, repeated),
        )

    @contextlib.contextmanager
    def around(self) -> Iterator[None]:
        """Inside, ranks pool nothing; for recording CUDA graphs, no garbage is looked for."""
        gc.collect()
        gc.freeze()
        try:
            with alone(), engine.without_early_starts():
                yield
        finally:
            gc.unfreeze()

    def saved(self) -> str:
        return folders.to_continue(self.folder)

    def finish(self) -> None:
        """Shows the members, and does with the best one what `cfg.finish` asks for."""
        cfg, root, samples = self.cfg, self.folder, self.training.samples
        console.say(table(self.training, root))
        n_generations = self.training.generation
        del self.training, self.trainers  # frees GPU memory for the evaluation
        generations = from_rank_0(lambda: populations.read(root / populations.FILE))
        if n_generations and not any("score" in row for row in itertools.chain(*generations)):
            console.say(UNSCORED)
        number = from_rank_0(lambda: populations.best(root))
        text = "No member has a score, so none is the best"
        if number is not None:
            best = populations.folder_of(root, number)
            finishing.finish(cfg, best, samples)
            command = folders.command_of("evaluate", "run", root)
            text = f"The best is in {best}\nTo evaluate it: {command}"
        if cfg.rerun and self.is_first:
            finishing.compare(root, Path(cfg.rerun))
        console.say(f"Trained {samples:,} samples of each member. {text}")
        process_group.exchange([0])  # the others wait for what follows on rank 0


def member_settings(cfg: settings.Train, member: int) -> settings.Train:
    """Returns the settings of a member, which are those of a run alone until it first copies."""
    seed, drawn = cfg.seed, decisions.first(cfg.seed, member, cfg.population.vary)
    for part in ("learner", "env"):
        values = {key[len(part) + 1 :]: x for key, x in drawn.items() if key.startswith(f"{part}.")}
        cfg = settings.changed(cfg, **{part: settings.changed(getattr(cfg, part), **values)})
    rerun = cfg.rerun and str(populations.folder_of(Path(cfg.rerun), member))
    return settings.changed(
        cfg,
        seed=seed_of("member", member, seed),
        rerun=rerun,
        population=settings.changed(cfg.population, member=member),
        checkpoints=settings.changed(cfg.checkpoints, keep=max(KEPT, cfg.checkpoints.keep)),
        folder=None,
    )


def table(population: Population, root: Path) -> str:
    """Returns a table of the members, once all have written their metrics. All ranks call it."""
    ranked_by = population.chosen.score
    runs = [trainer.saver.folder.parent for trainer in population.trainers]
    scores = population.gathered([populations.score_of(run, ranked_by) for run in runs])
    generations, keys = populations.read(root / populations.FILE), [*population.chosen.vary]
    rows = []
    for member, score in enumerate(scores):
        shown = [f"{population.settings[member][key]:.3g}" for key in keys]
        first = populations.lineage(generations, member)[0]
        score = "" if score is None else f"{score:.4g}"
        n_diverged = str(population.n_diverged[member] or "")
        rows.append([str(member), score, str(first), *shown, n_diverged])
    is_return = ranked_by in (populations.RUNNING, populations.EVALUATED)
    title = "return" if is_return else ranked_by
    return console.table(["member", title, "descends from", *keys, "diverged"], rows)
