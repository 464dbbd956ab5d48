"""The base classes of the built-in learners, and the rules of all.

A learner is the class behind `learner=module:Class`. It does not have to inherit from anything: it
needs the attributes of `megastep.agents.types.Learner`; docs/learners.md has an example, and a
table of what is optional.

- `collect()` returns a `megastep.agents.types.RolloutLike`, which may be the same object every
  time. Neither it nor `update()` synchronises.
- A `check` gets `rollout.floats()` in every `update()`, which skips a rollout with non-finite
  numbers. The trainer stops after many skipped updates in a row.
- Only transitions with `rollout.learns` and without `rollout.reset` count in a loss. An environment
  with opponents has an attribute `learners`, a bool per lane; only those lanes need to be stored.
- `collector(env)` resets the environment before it returns: a run then gives the lanes random ages.
- `generator.stream_seed(seed, name)` makes the seed of each random stream of the run's.

Building blocks for your own learner: `GradientLearner`, `storage.rollout.make_rollout`,
`storage.collector.Collector`, `gradient_steps.GradientSteps`, `cuda_graph.CudaGraphUpdate`,
`masked_stats` and `returns`.
"""

import functools
from collections.abc import Callable, Iterable
from typing import Annotated

import torch
from pydantic import AfterValidator, Field

from megastep.agents.algorithms import optimizers
from megastep.agents.algorithms.cuda_graph import CudaGraphUpdate
from megastep.agents.algorithms.gradient_steps import GradientSteps
from megastep.agents.algorithms.masked_stats import masked_mean
from megastep.agents.errors import UserError, shortened
from megastep.agents.generator import SeededGenerator, seeded, stream_seed
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.collector import Collector
from megastep.agents.storage.rollout import Rollout, bytes_per_step, make_rollout, without_last
from megastep.agents.types import StateDict
from megastep.arrdict import arrdict
from megastep.coefficients import Coefficients
from megastep.imports import known_name
from megastep.schedules import Number, Scheduled
from megastep.settings import MAX_ENVS, AtMost, checked
from megastep.types import Env, optional

# Types of settings that several learners have.
Coefficient = Annotated[float, Field(ge=0, le=10**6)]
Positive = Annotated[float, Field(gt=0, le=10**6)]
# Those that may be schedules.
ScheduledCoefficient = Annotated[Number, Scheduled(ge=0, le=10**6)]
ScheduledPositive = Annotated[Number, Scheduled(gt=0, le=10**6)]
ScheduledFraction = Annotated[Number, Scheduled(ge=0, le=1)]
OptimizerName = Annotated[
    str, AfterValidator(functools.partial(known_name, names=optimizers.NAMES))
]


class GradientLearner:
    """Base of the built-in learners: policy, gradient steps, CUDA graph, learning rate and state.

    A subclass adds its settings and `_update`, and sets `loss_coefficients` before it calls this
    constructor. A subclass of one of the learners adds a loss of its own by
    `extra_loss` and, for weights that acting does not need, `extra_parameters`.

    Args:
        policy: the policy to improve, in place.
        n_steps: steps of a rollout, T.
        lr: step size. Like `gamma`, `lambda_`, the clips and the coefficients of the loss it is a
            number or a schedule.
        weight_decay: decoupled weight decay (AdamW) of the layers' weights, not of biases.
        gamma: discount per step.
        max_grad_norm: longer gradients are scaled down to this norm.
        optimizer: `adam` or `adamw`, one kernel on a GPU; or the import path of a class like those
            of `torch.optim`.
        warmup: updates over which the step size rises linearly to `lr`.
        graph: on a GPU, captures updates as a CUDA graph. Always pass the same rollout then.
        seed: seed of the minibatch order and of replay sampling.

    A rollout with a number that is not finite, or beyond `nonfinite.LIMIT`, changes nothing.

    Metrics:
        loss/grad_norm: norm of the gradient before it is clipped.
        loss/skipped_steps: gradient steps skipped because of non-finite numbers.

    Attributes:
        coefficients: the `Coefficients` of the loss, and `lr`.
        steps: the `GradientSteps` of the policy's parameters.
        generator: the `SeededGenerator` of all random numbers in an update.
        has_extra_loss: whether a subclass has an `extra_loss` of its own.
        loss_coefficients: numbers and schedules of the loss by name, besides `gamma`.
    """

    n_minibatches = n_networks = 1
    loss_coefficients: dict[str, Number] = {}
    critic_lr: float | None = None
    desired_kl: float | None = None
    #: Reads the learning rate from the device, if the learner changes it itself.
    read_lr: Callable[[], float] | None = None
    _is_checked = False

    @checked
    def __init__(
        self,
        policy: Policy,
        *,
        n_steps: Annotated[int, Field(ge=1, le=65_536)] = 32,
        lr: ScheduledPositive = 1e-3,
        weight_decay: Coefficient = 0.0,
        gamma: ScheduledFraction = 0.995,
        max_grad_norm: Positive = 0.5,
        optimizer: OptimizerName = "adam",
        warmup: Annotated[int, Field(ge=0, le=10**9)] = 0,
        graph: bool = False,
        seed: int = 1,
    ):
        self.policy, self.device, self.n_steps = policy, policy.device, n_steps
        self.has_extra_loss = type(self).extra_loss is not GradientLearner.extra_loss
        numbers = dict(lr=lr, gamma=gamma, **self.loss_coefficients)
        self.coefficients = Coefficients(policy.device, **numbers)
        self.lr, self.warmup = self.coefficients.values["lr"], warmup
        if self.desired_kl is not None:
            if warmup or "lr" in self.coefficients.schedules:
                raise ValueError(
                    "desired_kl changes the learning rate, so it cannot be combined with warmup "
                    "or a schedule of lr"
                )
            self.read_lr = self.coefficients.tensors["lr"].item
        factors: dict = {}
        if self.critic_lr is not None and policy.critic is not None:
            factors = dict.fromkeys(policy.critic.parameters(), self.critic_lr / self.lr)
        layers = (p for name, p in policy.named_parameters() if p.ndim > 1 and "weight" in name)
        self.extra = self._make_extra()
        self.steps = GradientSteps(
            [*policy.parameters(), *self.extra],
            self.coefficients.tensors["lr"],
            max_grad_norm,
            self.device,
            optimizer,
            lr_factors=factors,
            weight_decays=dict.fromkeys(layers, weight_decay),
        )
        self.check, self.optimizer = self.steps.check, self.steps.optimizer
        self.generator = SeededGenerator(stream_seed(seed, "learner"))
        graph = graph and self.optimizer.capturable
        self.cuda_graph = CudaGraphUpdate(self._update, self.device, graph, (self.generator,))

    def collector(self, env: Env, values: bool = True) -> Collector:
        """Returns a collector of rollouts of `n_steps` steps, with the critic's `values`."""
        self.policy.clear_stats()
        return Collector(env, self.policy, make_rollout(env, self.policy, self.n_steps, values))

    def minibatch_rows(self) -> float:
        """Returns the rows of a minibatch per lane of the environment."""
        return (self.n_steps + 1) / self.n_minibatches

    def bytes_per_env(self, env: Env) -> float:
        """Returns about how many bytes a rollout and a minibatch take per environment."""
        per_row = bytes_per_step(env, self.policy)
        # 96 bytes per unit, and 32 for each layer above the first; an LSTM needs 45 and 26
        activations = self.n_networks * 4 * (16 + 8 * self.policy.layers) * self.policy.width
        # values are of the features of a whole rollout, 4 bytes per unit
        rollout = (self.n_steps + 1) * (per_row + 4 * self.policy.width)
        minibatch = self.minibatch_rows() * (per_row + activations)
        return optional(env, "n_agents") * (rollout + minibatch)

    def update(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Learns from a rollout. Returns metrics as tensors () on the device, averaged over the
        gradient steps. ValueError if there are fewer lanes than minibatches.
        """
        if rollout.n_lanes < self.n_minibatches:
            raise ValueError(
                f"{rollout.n_lanes} lanes cannot be split into {self.n_minibatches} minibatches of "
                "whole lanes: use fewer minibatches (n_minibatches) or more lanes"
            )
        return {f"loss/{name}": value for name, value in self.cuda_graph(rollout).items()}

    def _update(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Performs one update without synchronising, so that it can be captured."""
        raise NotImplementedError

    def minibatches(self, n_lanes: int) -> tuple[torch.Tensor, ...]:
        """Returns the lanes of each minibatch, (M,) int64, in a random order."""
        keys = torch.rand(n_lanes, generator=self.generator.on(self.device), device=self.device)
        return keys.argsort(stable=True).tensor_split(self.n_minibatches)

    def set_lr(self, lr: float) -> None:
        """Changes the step size, the critic's by the same factor, also for a captured update."""
        self.coefficients.set(lr=lr)

    # ---- A loss of one's own ----

    def extra_parameters(self) -> Iterable[torch.nn.Parameter]:
        """Returns parameters that only `extra_loss` needs, which are none here. Called once, before
        the optimizer is made, with a seed that all ranks share. They are part of the learner's
        state, not of the policy.
        """
        return ()

    def extra_loss(
        self, features: torch.Tensor, batch: arrdict
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Returns a loss () that is added to the learner's, and metrics () by name. Here it is the
        error of predicting privileged observations, if the critic is asymmetric, and 0 else.

        Args:
            features: (T, M, width) of the actor, from which gradients flow into it.
            batch: T steps of M lanes as `Rollout.sequences` has them, `obs`, `starts` and
                `privileged` with a last row more, and `valid` (T, M), the steps to average over.
        """
        if not self.policy.privileged_space:
            return features.new_zeros((), dtype=torch.float32), {}
        privileged = without_last(batch["privileged"])
        errors = self.policy.prediction_error(features, privileged)
        error = masked_mean(errors, batch["valid"])
        return self.coefficients["auxiliary_coef"] * error, {"auxiliary": error}

    def _make_extra(self) -> list[torch.nn.Parameter]:
        with seeded(stream_seed(self.policy.seed, "extra")):
            parameters = [*self.extra_parameters()]
        for parameter in parameters:
            if not isinstance(parameter, torch.nn.Parameter):
                raise UserError(
                    f"{type(self).__name__}.extra_parameters must return parameters, not "
                    f"{type(parameter).__name__}; use module.parameters()"
                )
            parameter.data = parameter.data.to(self.device)
        return parameters

    def extra_terms(
        self, features: torch.Tensor, batch: arrdict, taken: Iterable[str] = ()
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Returns `extra_loss`, checked, and its metrics without gradients. UserError if it fails,
        is not a scalar, teaches nothing, or has the name of a metric `taken` by the learner.
        """
        name = f"{type(self).__name__}.extra_loss"
        try:
            extra, own = self.extra_loss(features, batch)
        except Exception as error:
            problem = f"{type(error).__name__}: {shortened(error, 300)}"
            raise UserError(f"{name} failed ({problem}); it returns (loss, metrics)") from error
        for key, value in {"loss": extra, **own}.items():
            given = tuple(value.shape) if isinstance(value, torch.Tensor) else repr(value)
            if given != ():
                raise UserError(
                    f"{name} must return tensors of shape (), such as means over batch.valid, but "
                    f"{key} is {given}"
                )
            if key in taken:
                raise UserError(f"{name}: the learner has a metric {key} itself; use another name")
        if self.has_extra_loss and not self._is_checked:
            self._is_checked = True
            targets = self.extra or [p for p in self.policy.parameters() if p.requires_grad]
            options: dict = dict(retain_graph=True, allow_unused=True)
            if not extra.requires_grad or not any(
                gradient is not None for gradient in torch.autograd.grad(extra, targets, **options)
            ):
                what = "of extra_parameters()" if self.extra else "of the policy"
                raise UserError(
                    f"{name} touches no parameter {what}, so it teaches nothing: compute it from "
                    "features and from your parameters, without detach() or no_grad"
                )
        return extra, {key: value.detach() for key, value in own.items()}

    @torch.no_grad()
    def _load_extra(self, saved) -> None:
        for parameter, source in zip(self.extra, saved, strict=True):
            parameter.copy_(source)

    # ---- State ----

    def state_dict(self) -> StateDict:
        """Returns optimizer, learning rate, coefficients and generators as plain tensors and
        numbers, without the policy's weights, rollouts and a replay buffer.
        """
        return dict(
            learner=type(self).__name__,
            **self.steps.state_dict(),
            coefficients={k: v for k, v in self.coefficients.values.items() if k != "lr"},
            **({"extra": [parameter.detach() for parameter in self.extra]} if self.extra else {}),
            generator=self.generator.state_dict(),
            policy_generator=self.policy.generator.state_dict(),
        )

    def copy_from(self, other: "GradientLearner") -> None:
        """Takes over what another learner of the same class and sizes has learnt, the policy's
        weights too, in place. Generators and rollouts stay this one's.
        """
        self.policy.load_state_dict(other.policy.state_dict())
        self.steps.optimizer.load_state_dict(other.steps.optimizer.state_dict())
        self.coefficients.set(**other.coefficients.values)
        self.steps.copy_from(other.steps)
        self._load_extra(other.extra)

    def check_state(self, state: StateDict) -> None:
        """Raises ValueError if a `state_dict` is not one that `load_state_dict` continues from."""
        name = type(self).__name__
        if (saved_name := state.get("learner", name)) != name:
            raise ValueError(
                f"the state of a {saved_name} learner cannot be loaded by {name}: use "
                f"{saved_name}, or start from the policy's weights alone (init=RUN)"
            )
        saved, own = (
            [tuple(leaf.shape) for leaf in leaves]
            for leaves in (state.get("extra", []), self.extra)
        )
        if saved != own:
            raise ValueError(
                f"extra_parameters() have shapes {own}, and those saved have {saved}: continue "
                f"with the same {name}"
            )

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`, which may come from another device; see `check_state`."""
        self.check_state(state)
        self.steps.load_state_dict(state)
        saved = state["coefficients"]
        self.coefficients.set(**{k: v for k, v in saved.items() if k in self.coefficients.values})
        self._load_extra(state.get("extra", []))
        self.generator.load_state_dict(state["generator"], self.device)
        self.policy.generator.load_state_dict(state["policy_generator"], self.device)
        self.cuda_graph.restart()


class ActorCritic(GradientLearner):
    """Base of PPO and V-trace. Its policy needs a critic, else ValueError.

    Args:
        critic_lr: step size of the critic's own parameters, those under "critic."; it falls
            with `lr`. None: `lr`.
        lambda_: decay of GAE, or of V-trace's traces.
        entropy_coef: weight of the entropy bonus, relative to the advantages.
        value_coef: weight of the value's squared error, measured in the value's own scale.
        auxiliary_coef: weight of the policy's `prediction_error`, with an asymmetric critic.
        n_epochs: passes over a rollout.
        n_minibatches: minibatches per pass; lanes are divided among them.
        desired_kl: changes the step size after each minibatch so that its KL divergence stays near
            this many nats (as in rsl_rl), without `warmup` or a schedule of `lr`. None: it does
            not.

    Other arguments are those of `GradientLearner`.

    Metrics:
        loss/policy: policy loss.
        loss/value: value loss, in units of the return's variance.
        loss/entropy: entropy of the policy; of continuous actions the differential entropy, which
            may be negative.
        loss/auxiliary: auxiliary loss of predicting the privileged observation.
        loss/kl: KL divergence from the acting policy, in nats.
        loss/explained_variance: fraction of the returns' variance that the value explains.
    """

    @checked
    def __init__(
        self,
        policy: Policy,
        *,
        critic_lr: Positive | None = None,
        lambda_: ScheduledFraction = 0.95,
        entropy_coef: ScheduledCoefficient = 0.01,
        value_coef: ScheduledCoefficient = 0.5,
        auxiliary_coef: ScheduledCoefficient = 0.5,
        n_epochs: Annotated[int, Field(ge=1, le=1000)] = 1,
        n_minibatches: Annotated[int, Field(ge=1, le=MAX_ENVS), AtMost("env.n_envs")] = 4,
        desired_kl: Positive | None = None,
        **settings,
    ):
        if policy.critic is None:
            name = type(self).__name__
            raise ValueError(f"{name} needs a policy with a critic: use agent.output=softmax")
        self.critic, self.critic_lr, self.desired_kl = policy.critic, critic_lr, desired_kl
        self.n_epochs, self.n_minibatches = n_epochs, n_minibatches
        numbers = dict(lambda_=lambda_, entropy_coef=entropy_coef, value_coef=value_coef)
        numbers |= dict(auxiliary_coef=auxiliary_coef)
        self.loss_coefficients = numbers | self.loss_coefficients
        super().__init__(policy, **settings)
