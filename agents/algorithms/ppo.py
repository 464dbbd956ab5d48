"""Proximal policy optimisation (Schulman et al. 2017) for recurrent policies.

Axes: T time, B lanes, M lanes of a minibatch. A minibatch is whole sequences of some lanes. Every
mean is over valid steps: those that the environment took, of lanes that learn. An update never
synchronises: what would be an `if` is a flag on the device.
"""

from typing import Annotated, Any

import torch
from pydantic import Field

from megastep.agents.algorithms import returns
from megastep.agents.algorithms.cuda_graph import CudaGraphUpdate
from megastep.agents.algorithms.gradient_steps import GradientSteps
from megastep.agents.algorithms.learner import (
    Coefficient,
    Fraction,
    Positive,
    check_minibatches,
    load_own_state,
    own_state,
)
from megastep.agents.algorithms.masked_stats import explained_variance, masked_mean, normalised
from megastep.agents.generator import SeededGenerator
from megastep.agents.storage.rollout import (
    Collector,
    Rollout,
    bytes_per_step,
    make_rollout,
    without_last,
)
from megastep.arrdict import arrdict
from megastep.settings import MAX_ENVS, checked


class PPO:
    """Improves a policy, in place, from rollouts it collected.

    n_steps           of a rollout
    lr                Adam's step size; `set_lr` changes it
    gamma, lambda_    discount per step, and the decay of GAE
    clip              how far the probability of an action may move, as a ratio, before the gradient
                      stops
    entropy_coef      what a nat of entropy is worth, in standard deviations of advantage
    value_coef        weight of the value's squared error, the value measured in its own scale
    auxiliary_coef    weight of the policy's `prediction_error`, where its critic is asymmetric
    max_grad_norm     longer gradients are shortened to this
    n_epochs, n_minibatches  passes over a rollout, and the parts each is cut into by lanes
    target_kl         once a minibatch finds the policy further than this (nats) from the one that
                      acted, the rest of the update is left out; None for never
    graph             on a GPU, captures the update as a CUDA graph; always with one and the same
                      rollout then

    A rollout with a number that is not finite, or beyond `finite.LIMIT`, changes nothing: no
    weight, no statistic. `check` tells which it was, and how many updates were skipped in a row.
    """

    @checked
    def __init__(
        self,
        policy: Any,
        *,
        n_steps: Annotated[int, Field(ge=1, le=65_536)] = 32,
        lr: Positive = 3e-4,
        gamma: Fraction = 0.99,
        lambda_: Fraction = 0.95,
        clip: Positive = 0.2,
        entropy_coef: Coefficient = 0.01,
        value_coef: Coefficient = 0.5,
        auxiliary_coef: Coefficient = 0.5,
        max_grad_norm: Positive = 0.5,
        n_epochs: Annotated[int, Field(ge=1, le=1000)] = 1,
        n_minibatches: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 4,
        target_kl: Positive | None = None,
        graph: bool = False,
        seed: int = 1,
    ):
        if policy.critic is None:
            raise ValueError("PPO needs a policy with a critic, and so agent.output=softmax")
        self.policy, self.device, self.n_steps = policy, policy.device, n_steps
        self.gamma, self.lambda_, self.clip, self.entropy_coef = gamma, lambda_, clip, entropy_coef
        self.value_coef, self.auxiliary_coef = value_coef, auxiliary_coef
        self.n_epochs, self.n_minibatches = n_epochs, n_minibatches
        self.target_kl = float("inf") if target_kl is None else target_kl
        self.lr = lr
        self.steps = GradientSteps(policy.parameters(), lr, max_grad_norm, self.device)
        self.check, self.optimizer = self.steps.check, self.steps.optimizer
        self.random = SeededGenerator(seed)
        self.cuda_graph = CudaGraphUpdate(self._update, self.device, graph, (self.random,))

    def set_lr(self, lr: float) -> None:
        """Changes Adam's step size, also for a captured update."""
        self.steps.set_lr(lr)

    def collector(self, env: Any) -> Collector:
        """What acts in `env`, and the memory of `n_steps` steps of its lanes."""
        return Collector(env, self.policy, make_rollout(env, self.policy, self.n_steps))

    def bytes_per_env(self, env: Any) -> float:
        """About how many bytes a rollout and a minibatch of it take per environment."""
        # a minibatch's share of the rollout, and of activations; the features that values are made
        # of, 4 bytes per unit
        each, parts = bytes_per_step(env, self.policy), self.n_minibatches
        each += (each + self.policy.activation_bytes) / parts + 4 * self.policy.width
        return env.n_agents * (self.n_steps + 1) * each

    def update(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Learns from a rollout. Returns means over its minibatches as tensors () on the device,
        among them `loss/skipped_steps`, how many gradients were not finite and so were not
        followed. ValueError if its lanes cannot be cut into minibatches.
        """
        check_minibatches(self.n_minibatches, rollout.n_lanes)
        return {f"loss/{key}": value for key, value in self.cuda_graph(rollout).items()}

    def _update(self, rollout):
        is_fine = self.steps.begin(rollout.numbers())
        transitions = rollout.transitions()
        estimates = returns.gae(**transitions, gamma=self.gamma, lambda_=self.lambda_)
        estimates["valid"] = estimates.valid & rollout.learns[:-1]
        self.policy.critic.output.update_stats(estimates.targets, estimates.valid & is_fine)
        explained = explained_variance(transitions["value"], estimates.targets, estimates.valid)
        estimates["advantages"] = normalised(estimates.advantages, estimates.valid)

        stopped = torch.zeros((), dtype=torch.bool, device=self.device)
        for _ in range(self.n_epochs):
            order = torch.rand(
                rollout.n_lanes, generator=self.random.on(self.device), device=self.device
            ).argsort()
            for rows in order.tensor_split(self.n_minibatches):
                batch = arrdict(
                    {**rollout.sequences(rows), **estimates.map(torch.index_select, 1, rows)}
                )
                loss, metrics = self._losses(batch)
                stopped = stopped | (metrics["kl"] > self.target_kl)
                self.steps.take(loss, metrics, batch.valid.any(), ~stopped)
        # Only now: a rollout is learnt from as it was seen. One row is enough, B lanes again with
        # every rollout.
        last = rollout.world(-1)
        self.policy.update_stats(last.obs, last.get("privileged"), is_fine & rollout.learns[-1])
        return {**self.steps.end(), "explained_variance": explained}

    def _losses(self, batch):
        """The loss of a minibatch, and what there is to say about it, each a tensor ()."""
        obs, starts, privileged = map(
            without_last, (batch.obs, batch.starts, batch.get("privileged"))
        )
        now = self.policy.unroll(obs, starts, batch.state)
        valid, output = batch.valid, self.policy.output
        log_ratio = output.logprob(now.logits, batch.actions) - batch.logprobs
        log_ratio = log_ratio.masked_fill(~valid, 0.0)  # or its exp may overflow, and 0 inf be nan
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - self.clip, 1 + self.clip)
        gain = torch.minimum(ratio * batch.advantages, clipped * batch.advantages)
        estimate = self.policy.value(now.features, privileged)
        error = (estimate - batch.targets) / self.policy.critic.output.scale

        policy = -masked_mean(gain, valid)
        value = masked_mean(error.square(), valid)
        entropy = masked_mean(output.entropy(now.logits), valid)
        with torch.no_grad():
            # >= 0 term by term, unlike the mean log ratio
            kl = masked_mean(ratio - 1 - log_ratio, valid)
            clip_fraction = masked_mean((ratio != clipped).float(), valid)
        loss = policy + self.value_coef * value - self.entropy_coef * entropy
        metrics = dict(
            policy=policy, value=value, entropy=entropy, kl=kl, clip_fraction=clip_fraction
        )
        if self.policy.privileged_space:
            error = self.policy.prediction_error(now.features, privileged)
            metrics["auxiliary"] = masked_mean(error, valid)
            loss = loss + self.auxiliary_coef * metrics["auxiliary"]
        return loss, metrics

    def state_dict(self) -> dict[str, Any]:
        """All that an update changes beside the policy's weights, and where the policy's random
        stream is: dicts of plain tensors and numbers.
        """
        return own_state(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a `state_dict`, taken on this device or another. ValueError if it is that of
        another kind of learner.
        """
        load_own_state(self, state)
