"""The contract of learners, and the base class of the built-in ones.

A learner is the class behind `learner=module:Class`. It does not have to inherit from anything: it
needs the attributes of `megastep.agents.types.Learner`, and is used like this:

    learner = Class(policy, seed=1, **settings)  # settings: its other constructor arguments
    collect = learner.collector(env)
    while training:
        rollout = collect()                      # T steps of B lanes
        losses = learner.update(rollout)         # scalar tensors by name

Rules:

- `collect()` returns a `megastep.agents.types.RolloutLike`; `storage.rollout.Rollout` is one. The
  collector owns the rollout and may return the same object every time. `collect.rollout` exists
  before the first call, too.
- `collect()` and `update()` do not synchronise host and device.
- A learner with a `check`, a `nonfinite.NonFiniteCheck`, passes `rollout.floats()` to it in every
  `update()` and skips a rollout with non-finite numbers. The trainer reads the check and stops
  after many skipped updates in a row. Without a check, a run stops when it is about to save weights
  that are not finite.
- Only transitions with `rollout.learns` and without `rollout.reset` count in a loss. An environment
  with opponents has an attribute `learners`, a bool per lane; only those lanes need to be stored.
- `collector(env)` resets the environment before it returns: a run then gives the lanes random ages.
- A collector that acts in the background may return an older rollout. It has a method `wait()`,
  which blocks until nothing acts in the environment.
- The constructor's arguments `seed` and `graph` are optional. `seed` receives the run's seed, which
  `generator.stream_seed(seed, name)` turns into that of a random stream of its own; `graph` is true
  if updates should be captured as a CUDA graph.
- A replay buffer belongs to the learner or to its collector.
- `megastep.agents.types.LearnerOptions` and `CollectorOptions` list what is optional.
  `bytes_per_env(env)` and, with a replay buffer, `replay_size(env)` are what a run checks its
  memory with before it starts.

Building blocks for your own learner: `GradientLearner`, `storage.rollout.make_rollout`,
`storage.rollout.bytes_per_step`, `storage.collector.Collector`, `gradient_steps.GradientSteps`,
`cuda_graph.CudaGraphUpdate`, `masked_stats` and `returns`.
"""

from typing import Annotated

import torch
from pydantic import Field

from megastep.agents.algorithms.cuda_graph import CudaGraphUpdate
from megastep.agents.algorithms.gradient_steps import GradientSteps
from megastep.agents.generator import SeededGenerator, stream_seed
from megastep.agents.networks.policy import Policy
from megastep.agents.networks.running_norm import VERSION
from megastep.agents.storage.rollout import Rollout
from megastep.agents.types import StateDict

# Types of settings that several learners have.
Coefficient = Annotated[float, Field(ge=0, le=10**6)]
Positive = Annotated[float, Field(gt=0, le=10**6)]
Fraction = Annotated[float, Field(ge=0, le=1)]

_ATTRIBUTES = {
    "collector": "a method collector(env) that returns a collector",
    "update": "a method update(rollout) that learns and returns scalar tensors by name",
    "lr": "the initial learning rate",
    "state_dict": "a method state_dict() that returns everything but the policy's weights",
    "load_state_dict": "a method load_state_dict(state) that continues from a state_dict",
}


class LearnerError(AssertionError):
    """A class does not keep the contract of learners. The message names the missing attribute."""


def check_learner(learner: object) -> None:
    """Raises LearnerError if a required attribute is missing."""
    for name, description in _ATTRIBUTES.items():
        if not hasattr(learner, name):
            raise LearnerError(f"it has no {name}: {description}")


def check_minibatches(n_minibatches: int, n_lanes: int) -> None:
    """Raises ValueError if there are fewer lanes than minibatches."""
    if n_lanes < n_minibatches:
        raise ValueError(
            f"{n_lanes} lanes cannot be split into {n_minibatches} minibatches of whole lanes: use "
            "fewer minibatches (n_minibatches) or more lanes"
        )


class GradientLearner:
    """Base of the built-in learners: policy, gradient steps, CUDA graph, learning rate and state.

    A subclass adds its settings, `collector`, `bytes_per_env` and `_update`, and sets
    `n_minibatches` if it splits lanes into minibatches.

    Args:
        policy: the policy to improve, in place.
        lr: Adam's step size.
        max_grad_norm: longer gradients are scaled down to this norm.
        graph: on a GPU, captures updates as a CUDA graph.
        seed: seed of the learner's own generator.
        critic_lr: Adam's step size of the critic's parameters. None: `lr`.
        weight_decay: Adam's weight decay, of parameters of two or more axes whose name contains
            "weight": those of layers, but no biases and no standard deviations.

    Metrics:
        loss/grad_norm: norm of the gradient before it is clipped.
        loss/skipped_steps: gradient steps skipped because of non-finite numbers.

    Attributes:
        steps: the `GradientSteps` of the policy's parameters.
        check: finds non-finite numbers in rollouts and counts skipped updates.
        generator: the `SeededGenerator` of all random numbers in an update.
    """

    n_minibatches = 1

    def __init__(
        self,
        policy: Policy,
        lr: float,
        max_grad_norm: float,
        graph: bool,
        seed: int,
        critic_lr: float | None = None,
        weight_decay: float = 0.0,
    ):
        self.policy, self.device, self.lr = policy, policy.device, lr
        factors = {}
        if critic_lr is not None and policy.critic is not None:
            factors = dict.fromkeys(policy.critic.parameters(), critic_lr / lr)
        layers = (p for name, p in policy.named_parameters() if p.ndim > 1 and "weight" in name)
        self.steps = GradientSteps(
            policy.parameters(),
            lr,
            max_grad_norm,
            self.device,
            lr_factors=factors,
            weight_decays=dict.fromkeys(layers, weight_decay),
        )
        self.check, self.optimizer = self.steps.check, self.steps.optimizer
        self.generator = SeededGenerator(stream_seed(seed, "learner"))
        self.cuda_graph = CudaGraphUpdate(self._update, self.device, graph, (self.generator,))

    def update(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Learns from a rollout.

        Returns metrics as tensors () on the device, averaged over the gradient steps.
        `loss/skipped_steps` counts the steps that were skipped because of non-finite numbers.

        Raises:
            ValueError: if there are fewer lanes than minibatches.
        """
        check_minibatches(self.n_minibatches, rollout.n_lanes)
        return {f"loss/{name}": value for name, value in self.cuda_graph(rollout).items()}

    def _update(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Performs one update without synchronising, so that it can be captured."""
        raise NotImplementedError

    def set_lr(self, lr: float) -> None:
        """Changes Adam's step size, the critic's by the same factor, also for a captured update."""
        self.steps.set_lr(lr)

    def state_dict(self) -> StateDict:
        """Returns optimizer, learning rate and generators as plain tensors and numbers.

        Does not include the policy's weights, rollouts or what a replay buffer holds.
        """
        return dict(
            learner=type(self).__name__,
            normalisation=VERSION,
            **self.steps.state_dict(),
            generator=self.generator.state_dict(),
            policy_generator=self.policy.generator.state_dict(),
        )

    def check_state(self, state: StateDict) -> None:
        """Raises ValueError if a `state_dict` is not one that `load_state_dict` continues from."""
        name = type(self).__name__
        saved_name = state.get("learner", name)
        if saved_name != name:
            raise ValueError(
                f"the state of a {saved_name} learner cannot be loaded by {name}: use "
                f"{saved_name}, or start from the policy's weights alone (init=RUN)"
            )
        if state.get("normalisation") != VERSION:
            raise ValueError(
                "a version of megastep that normalised observations and returns otherwise began "
                "this run: continue it with the version that began it, or start from its weights "
                "(init=RUN)"
            )

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`, which may come from another device.

        Raises:
            ValueError: if the state belongs to another class of learner, or to a version of
                megastep that normalised observations and returns otherwise.
        """
        self.check_state(state)
        self.steps.load_state_dict(state)
        self.generator.load_state_dict(state["generator"], self.device)
        self.policy.generator.load_state_dict(state["policy_generator"], self.device)
        self.cuda_graph.restart()
