"""Evaluations of a policy while it trains."""

from typing import TYPE_CHECKING

import torch

from megastep import global_generators
from megastep.agents import factory
from megastep.agents.errors import ConfigErrors
from megastep.agents.evaluation import playing
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.factory import settings
from megastep.agents.networks.policy import Policy
from megastep.env_state import way_back
from megastep.settings import closest
from megastep.types import Env, optional

if TYPE_CHECKING:
    from megastep.agents.distributed.ranks import Ranks


class Evaluator:
    """Measures a policy in episodes of environments of its own, in unseen homes. Each call plays
    the same episodes, where the environment can be set back, and changes nothing of the training.

    Args:
        cfg: settings of the run.
        trained_in: the environment of the training, whose wrappers may have learnt something.
        device: where to play.
        ranks: those that train the policy, which share the episodes.

    Raises:
        ConfigErrors: `cfg.evaluation.stop` names what no evaluation measures.
    """

    def __init__(self, cfg: settings.Train, trained_in: Env, device: torch.device, ranks: "Ranks"):
        homes, n = factory.homes(cfg.env, cfg.geometry, "test"), cfg.evaluation.episodes
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

    def __call__(self, policy: Policy) -> dict[str, float]:
        """Returns the means of `return`, `length` and each metric of the environment, over the
        finished episodes of the lanes that learn, or of all if none does; NaN without one.
        """
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
