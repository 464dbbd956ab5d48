"""Evaluations of a policy while it trains."""

import contextlib
from typing import TYPE_CHECKING

import torch

from megastep import global_generators
from megastep.agents import factory
from megastep.agents.errors import ConfigErrors
from megastep.agents.evaluation import playing
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.factory import settings
from megastep.agents.networks.policy import Policy
from megastep.arrdict import clone
from megastep.env_state import EnvState
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
        homes = factory.homes(cfg.env, cfg.geometry, "test")
        self.trained_in, self.state, self.start = trained_in, None, None
        with _generators_kept(device):
            self.where = EvalEnv(
                cfg.env, homes, cfg.evaluation.episodes, cfg.seed, device, ranks.n > 1
            )
            names = ["return", "length", *self.where.env.reset().get("metrics", {})]
            if optional(self.where.env, "resumable"):
                self.state = EnvState(self.where.env)
                self.start = clone(self.state.state_dict())
        for name in cfg.evaluation.stop:
            if name not in names:
                text = f"no evaluation here measures it; {closest(name, names)}"
                raise ConfigErrors([(f"evaluation.stop.{name}", text)])

    def __call__(self, policy: Policy) -> dict[str, float]:
        """Returns the means of `return`, `length` and each metric of the environment, over the
        finished episodes of the lanes that learn, or of all if none does; NaN without one.
        """
        env = self.where.env
        with _generators_kept(env.device):
            if self.state is not None:
                self.state.load_state_dict(clone(self.start))
            if learnt := optional(self.trained_in, "wrapper_state")():
                optional(env, "load_wrapper_state")(learnt, True)
            played = playing.first_episodes(env, policy.actor(), self.where.seed)
        learns = played["learns"] if played["learns"].any() else ~played["learns"]
        counted = learns & played["done"]
        columns = {"return": played["returns"], "length": played["lengths"], **played["metrics"]}
        values = {name: column[counted].double() for name, column in columns.items()}
        return {name: float(x[x.isfinite()].mean()) for name, x in values.items()}


def _generators_kept(device: torch.device) -> contextlib.ExitStack:
    stack = contextlib.ExitStack()
    stack.enter_context(global_generators.kept())
    if torch.device(device).type == "cuda":
        stack.enter_context(torch.random.fork_rng([device]))
    return stack
