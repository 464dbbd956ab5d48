"""Behaviour cloning for recurrent policies, from datasets that `megastep dump` writes.

T time, B lanes, M lanes of a minibatch.
"""

from typing import Annotated

import torch
from pydantic import Field

from megastep import data as datasets
from megastep import spaces
from megastep.agents.algorithms import learner
from megastep.agents.algorithms.masked_stats import masked_mean
from megastep.agents.networks.policy import Policy
from megastep.agents.networks.running_norm import add_moments, masked_moments
from megastep.agents.storage.dataset import DatasetCollector
from megastep.agents.storage.rollout import make_rollout, without_last
from megastep.agents.types import CollectorLike
from megastep.dotdict import leaves
from megastep.settings import MAX_ENVS, AtMost, checked
from megastep.types import Env

_PARTS = "obs", "starts", "actions", "mask"


class BC(learner.GradientLearner):
    """Clones the agent of a dataset: raises the log-probability of its actions. The environment
    takes no steps; it says which spaces there are, and evaluations play in it. Each of its lanes
    reads one episode after the other, and the hidden state goes on from rollout to rollout.

    A critic learns the returns of the stored episodes, so that PPO can go on with both (`init=`).

    Args:
        data: the folder of a dataset of npz files, with observations and actions of the same
            spaces. It is held on the device as a whole.
        policy_coef: weight of the actions' negative log-likelihood.
        value_coef: weight of the value's squared error, measured in the value's own scale.
        n_minibatches: minibatches per rollout; lanes are divided among them.

    Other arguments are those of `GradientLearner`.

    Metrics:
        loss/policy: negative log-likelihood of the dataset's actions, in nats.
        loss/value: value loss, in units of the return's variance.
        loss/entropy: entropy of the policy.
    """

    @checked
    def __init__(
        self,
        policy: Policy,
        *,
        data: str,
        policy_coef: learner.ScheduledCoefficient = 1.0,
        value_coef: learner.ScheduledCoefficient = 0.5,
        n_minibatches: Annotated[int, Field(ge=1, le=MAX_ENVS), AtMost("env.n_envs")] = 8,
        seed: int = 1,
        **settings,
    ):
        if policy.privileged_space:
            raise ValueError(
                "behaviour cloning has no privileged observations for an asymmetric critic: use "
                "agent.critic=plain"
            )
        self.dataset, self.n_minibatches, self.seed = datasets.load(data), n_minibatches, seed
        self.loss_coefficients = dict(policy_coef=policy_coef, value_coef=value_coef)
        super().__init__(policy, seed=seed, **settings)
        self.source: DatasetCollector | None = None

    def collector(self, env: Env, values: bool = False) -> CollectorLike:
        """Returns a collector of the dataset's episodes. ValueError names a space that differs."""
        own, stored = spaces.texts(env), self.dataset.about["spaces"]
        for name in {**own, **stored}:
            if own.get(name) != stored.get(name):
                raise ValueError(
                    f"{name} is {stored.get(name, 'missing')} in {self.dataset.folder}, and "
                    f"{own.get(name, 'missing')} in the environment: use the settings of env that "
                    "it was dumped with"
                )
        env.reset()
        self.policy.clear_stats()
        rollout = make_rollout(env, self.policy, self.n_steps, values)
        gamma = float(self.coefficients.values["gamma"])
        self.source = DatasetCollector(self.dataset, rollout, gamma, self.seed)
        return self.source

    def _update(self, rollout) -> dict[str, torch.Tensor]:
        assert self.source is not None
        policy, targets, valid = self.policy, self.source.returns, ~rollout.reset
        own_obs = policy.moments(rollout.world(-1)["obs"])
        of_all = *masked_moments(valid, targets), *own_obs
        is_finite, (of_targets, *of_obs) = self.steps.begin(rollout.floats(), *of_all)
        if policy.critic is not None:
            policy.critic.output.add(of_targets, is_finite)
        others = dict(valid=valid, targets=targets)
        for lanes in self.minibatches(rollout.n_lanes):
            batch = rollout.sequences(lanes, _PARTS, others)
            loss, metrics, state = self._losses(batch)
            self.steps.backward(loss, metrics, batch.valid.sum())
            self.steps.take()
            # the next rollout goes on from here
            for leaf, new in zip(leaves(rollout.state), leaves(state), strict=True):
                leaf.index_copy_(0, lanes, new.detach().to(leaf.dtype).nan_to_num(0.0, 0.0, 0.0))
        add_moments(policy.norms, of_obs, is_finite)
        return self.steps.end()

    def _losses(self, batch) -> tuple[torch.Tensor, dict[str, torch.Tensor], dict]:
        policy, valid = self.policy, batch.valid
        sequence = without_last(batch.obs), without_last(batch.starts), batch.state
        with policy.compute_dtype():
            now = policy.unroll(*sequence, mask=without_last(batch.get("mask")))
            logprobs, entropies = policy.output.terms(now.logits, batch.actions)
            nll, entropy = -masked_mean(logprobs, valid), masked_mean(entropies, valid)
            metrics = dict(policy=nll, entropy=entropy)
            loss = self.coefficients["policy_coef"] * nll
            if policy.critic is not None:
                error = (policy.value(now.features) - batch.targets) / policy.critic.output.scale
                metrics["value"] = masked_mean(error.square(), valid)
                loss = loss + self.coefficients["value_coef"] * metrics["value"]
            if self.has_extra_loss:
                extra, own = self.extra_terms(now.features, batch, metrics)
                loss, metrics = loss + extra, metrics | own
        return loss, metrics, now.state
