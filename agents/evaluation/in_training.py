"""Evaluations of a policy while it trains."""

from typing import Any

import torch

from megastep import global_generators
from megastep.agents.distributed.ranks import Ranks
from megastep.agents.errors import ConfigErrors
from megastep.agents.evaluation import playing
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.factory import make as factory
from megastep.agents.factory import settings
from megastep.agents.networks.policy import Policy
from megastep.agents.training.budget import reaches
from megastep.agents.training.trainer import Trainer
from megastep.env_state import way_back
from megastep.settings import closest
from megastep.types import Env, optional


class Evaluations:
    """A callback that evaluates the policy for some reports, in unseen homes. A checkpoint follows,
    whose score is the return. Each time plays the same episodes, where the environment can be set
    back, and neither changes anything of the training nor counts as its time. Raises ConfigErrors:
    `cfg.evaluation.stop` names what no evaluation measures.

    Args:
        cfg: settings of the run.
        trained_in: the environment of the training, whose wrappers may have learnt something.
        device: where to play.
        ranks: those that train the policy, which share the episodes.
    """

    def __init__(self, cfg: settings.Train, trained_in: Env, device: torch.device, ranks: Ranks):
        homes, n = factory.homes(cfg.env, cfg.geometry, "test"), cfg.evaluation.episodes
        self.every, self.unit = settings.every(cfg.evaluation.every or 1)
        self.stop, self.last = cfg.evaluation.stop, {"samples": 0.0, "seconds": 0.0}
        self.trained_in = trained_in
        self.gpus = [device] if torch.device(device).type == "cuda" else []
        with global_generators.kept(), torch.random.fork_rng(self.gpus):
            self.where = EvalEnv(cfg.env, homes, n, cfg.seed, device, ranks.n > 1)
            env = self.where.env
            names = ["return", "length", *env.reset().get("metrics", {})]
            self.go_back = way_back(env) if optional(env, "resumable") else None
        for name in cfg.evaluation.stop:
            if name not in names:
                text = f"no evaluation here measures it; {closest(name, names)}"
                raise ConfigErrors([(f"evaluation.stop.{name}", text)])

    def on_start(self, trainer: Trainer) -> None:
        """Ends a run that has reached its end before."""
        self.last = {"samples": trainer.samples_at_report, "seconds": trainer.clock.seconds}
        if reaches(trainer.evaluation, self.stop):
            trainer.end()

    def on_update(self, trainer: Trainer, losses: object) -> None:
        """Forgets the score: it was another policy's."""
        trainer.score = None

    def on_measure(self, trainer: Trainer, metrics: dict[str, Any]) -> None:
        """Evaluates if it is time to, which all ranks do at once.

        Metrics:
            eval/NAME: what an evaluation in training measured: `return`, `length`, and each metric
                of the environment, means over episodes in unseen homes.
        """
        now = {"samples": trainer.samples, "seconds": trainer.clock.seconds}
        is_due = now[self.unit] // self.every > self.last[self.unit] // self.every
        self.last, trainer.score = now, None
        if not trainer.ranks.any(is_due):
            return
        for gpu in self.gpus:  # what other members of a population have launched counts
            torch.cuda.synchronize(gpu)
        with trainer.clock.paused():
            measured = self.measure(trainer.policy)
        trainer.evaluation = trainer.ranks.mean(measured)
        trainer.score, trainer.is_save_due = trainer.evaluation.get("return"), True
        metrics |= {f"eval/{name}": value for name, value in trainer.evaluation.items()}

    def on_report(self, trainer: Trainer, metrics: dict[str, Any]) -> None:
        """Ends the run if the evaluation reaches `stop`."""
        if trainer.is_save_due and reaches(trainer.evaluation, self.stop):
            metrics["perf/seconds_to_stop"] = metrics["perf/seconds"]
            trainer.end()

    def measure(self, policy: Policy) -> dict[str, float]:
        """Returns means over the finished episodes of lanes that learn, or of all; or NaN."""
        env = self.where.env
        with global_generators.kept(), torch.random.fork_rng(self.gpus):
            if self.go_back is not None:
                self.go_back()
            if learnt := optional(self.trained_in, "wrapper_state")():
                optional(env, "load_wrapper_state")(learnt, True)
            played = playing.first_episodes(env, policy.actor(), self.where.seed)
        learns = played["learns"] if played["learns"].any() else ~played["learns"]
        counted = learns & played["done"]
        columns = {"return": played["returns"], "length": played["lengths"], **played["metrics"]}
        values = {name: column[counted].double() for name, column in columns.items()}
        return {name: float(x[x.isfinite()].mean()) for name, x in values.items()}
