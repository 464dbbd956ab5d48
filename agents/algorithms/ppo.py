"""Proximal policy optimisation (PPO, Schulman et al. 2017) for recurrent policies.

T time, B lanes, M lanes of a minibatch. A minibatch holds whole sequences of some lanes. Means are
over valid steps: those that the environment took, of lanes that learn. An update never
synchronises: conditions are bool tensors on the device.
"""

from collections.abc import Mapping
from typing import Literal

import torch
from torch.autograd.function import once_differentiable

from megastep.agents.algorithms import learner, returns
from megastep.agents.algorithms.gradient_steps import one
from megastep.agents.algorithms.kernels import LIBRARY
from megastep.agents.algorithms.masked_stats import masked_mean, pooled_normalise
from megastep.agents.networks.fused import aligned, fused
from megastep.agents.networks.heads import MultiDiscreteOutput
from megastep.agents.networks.linear import cast, gradient_of_weights, sum_rows
from megastep.agents.networks.policy import Policy
from megastep.agents.networks.running_norm import add_moments, masked_moments, normalise_masked
from megastep.agents.storage.rollout import SEQUENCES, without_last
from megastep.arrdict import arrdict
from megastep.coefficients import on_device
from megastep.kernels.build.launch import BLOCK, Blocks, launch
from megastep.settings import checked

_ROWS, _THREADS = LIBRARY.constants["JOINT_ROWS"], LIBRARY.constants["JOINT_THREADS"]
_N_SUMS = LIBRARY.constants["N_JOINT_SUMS"]
_MAX_WIDTH = 3072  # of features, whose weights fit into 99 KB: a block of any GPU may have that
_PARTS = "starts", "actions", "logprobs", "mask"  # of a rollout, that a minibatch copies
_COEFFICIENTS = "clip", "value_coef", "entropy_coef", "auxiliary_coef"
_METRICS = "policy", "value", "entropy", "kl", "clip_fraction", "auxiliary"


def _fields(batch, value_scale, coefficients) -> dict:
    """Returns what kernels take of a minibatch and of the loss's settings."""
    numbers, device = dict(coefficients), value_scale.device
    value_clip = numbers.pop("value_clip")
    tensors = dict(old_logprobs=batch.logprobs, advantages=batch.advantages)
    tensors |= dict(targets=batch.targets, valid=batch.valid)
    tensors["old_values"] = None if value_clip is None else batch.old_value
    return dict(
        {name: None if x is None else x.contiguous() for name, x in tensors.items()},
        **{name: on_device(number, device) for name, number in numbers.items()},
        **dict(n_valid=batch.n_valid, value_scale=value_scale, value_clip=value_clip or 0.0),
    )


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, logprobs, entropies, values, errors, batch, value_scale, coefficients
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.set_materialize_grads(False)
        inputs = dict(logprobs=logprobs, entropies=entropies, values=values, errors=errors)
        names = "d_logprobs", "d_entropies", "d_values", "d_errors"
        gradients = [logprobs.new_empty(logprobs.shape) for _ in range(3 + (errors is not None))]
        n_rows, blocks = logprobs.numel(), Blocks(-(-logprobs.numel() // BLOCK))
        sums = logprobs.new_empty(blocks.x, LIBRARY.constants["N_SUMS"])
        launch(
            *(LIBRARY, "ppo_loss", logprobs.device, blocks),
            **{name: None if x is None else x.contiguous() for name, x in inputs.items()},
            **{**dict.fromkeys(names), **dict(zip(names, gradients))},
            **_fields(batch, value_scale, coefficients),
            **dict(sums=sums, n_rows=n_rows),
        )
        ctx.save_for_backward(*gradients)
        means = sums.sum(0)
        metrics, loss = means[:-1], means[-1]
        ctx.mark_non_differentiable(metrics)
        return loss, metrics

    @staticmethod
    @once_differentiable
    def backward(ctx, d_loss, d_metrics) -> tuple[torch.Tensor | None, ...]:
        gradients = ctx.saved_tensors
        if d_loss.data_ptr() != one(d_loss.device).data_ptr():
            gradients = torch._foreach_mul(gradients, d_loss)  # pyright: ignore[reportPrivateImportUsage]
        return *gradients, *[None] * (7 - len(gradients))


class _JointLoss(torch.autograd.Function):
    """The heads of a plain critic and of few actions, and the loss, with all gradients."""

    @staticmethod
    def forward(
        ctx, batch, output, coefficients, features, *parameters
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.set_materialize_grads(False)
        features = aligned(features.flatten(0, -2))
        heads = [cast(leaf, features.dtype, multiple=8) for leaf in parameters]
        n_rows, width = features.shape
        d_features, d_columns = torch.empty_like(features), features.new_empty(n_rows, 16)
        names = "weight", "bias", "value_weight", "value_bias"
        blocks = Blocks(-(-n_rows // _ROWS), 1, _THREADS, 32 * (width + 2))
        sums = features.new_empty(blocks.x, _N_SUMS, dtype=torch.float32)
        launch(
            *(LIBRARY, "joint_loss", features.device, blocks),
            **dict(zip(names, map(aligned, heads)), actions=batch.actions.long().contiguous()),
            **dict(features=features, d_features=d_features, d_columns=d_columns, sums=sums),
            **_fields(batch, output.scale, coefficients),
            **dict(value_mean=output.mean, n_rows=n_rows),
            **dict(width=width, n_choices=len(parameters[0])),
        )
        sums = sum_rows(sums)
        ctx.save_for_backward(features, d_features, d_columns, sums)
        ctx.lead, ctx.n_choices = batch.valid.shape, len(parameters[0])
        metrics, loss = sums[: len(_METRICS)], sums[len(_METRICS)]
        ctx.mark_non_differentiable(metrics)
        return loss, metrics

    @staticmethod
    @once_differentiable
    def backward(ctx, d_loss, d_metrics) -> tuple[torch.Tensor | None, ...]:
        features, d_features, d_columns, sums = ctx.saved_tensors
        if d_loss.data_ptr() != one(d_loss.device).data_ptr():
            d_features, d_columns, sums = (
                x * d_loss.to(x.dtype) for x in (d_features, d_columns, sums)
            )
        d_weight, d_bias = gradient_of_weights(d_columns, features), sums[len(_METRICS) + 1 :]
        n, d_features = ctx.n_choices, d_features.unflatten(0, ctx.lead)
        return None, None, None, d_features, d_weight[:n], d_bias[:n], d_weight[8:9], d_bias[8:9]


def _joint_loss(policy, batch, coefficients, has_errors, obs, privileged, lanes) -> tuple:
    starts, output = without_last(batch.starts), policy.critic.output
    with policy.compute_dtype():
        features, _ = policy._features(obs, starts, batch.state, lanes)
        parameters = *policy.output.linear.parameters(), *output.linear.parameters()
        features = features.to(torch.bfloat16)
        loss, means = _JointLoss.apply(batch, output, coefficients, features, *parameters)
    return loss, dict(zip(_METRICS[:-1], means.unbind())), features


def _takes_joint_loss(policy, batch, coefficients, has_errors, *_) -> bool:
    output, is_plain = policy.output, has_errors and not policy.critic.is_asymmetric
    is_few = type(output) is MultiDiscreteOutput and output.shape[0] == 1 and output.shape[1] <= 8
    is_known = is_plain and is_few and type(policy).terms is Policy.terms and "mask" not in batch
    is_bf16 = policy.bf16 and policy.device.type == "cuda"
    if not is_known or not is_bf16 or policy.width % 32 or policy.width > _MAX_WIDTH:
        return False
    return torch.cuda.get_device_capability(policy.device) >= (8, 0)


def _loss_on_gpu(**inputs) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    names = "logprobs", "entropies", "values", "errors", "batch", "value_scale", "coefficients"
    loss, means = _Loss.apply(*(inputs[name] for name in names))
    metrics: dict[str, torch.Tensor] = dict(zip(_METRICS, means.unbind(), strict=True))
    if inputs["errors"] is None:
        metrics.pop("auxiliary")
    return loss, metrics


@fused(_loss_on_gpu, lambda logprobs, **_: logprobs.is_cuda)
def ppo_loss(
    *,
    logprobs: torch.Tensor,
    entropies: torch.Tensor,
    values: torch.Tensor,
    errors: torch.Tensor | None,
    batch: arrdict,
    value_scale: torch.Tensor,
    coefficients: Mapping,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Returns the loss, a mean over the valid steps, and its metrics, tensors ().

    Args:
        logprobs: (T, M) float32, of the actions.
        entropies: (T, M), of the policy.
        values: (T, M), in units of reward.
        errors: (T, M), of the auxiliary prediction, or None.
        batch: has `logprobs`, `advantages`, `targets` and `valid`, (T, M) each, and `n_valid` (),
            the number of valid steps; with a `value_clip` also `old_value` (T, M).
        value_scale: (), the value's own scale.
        coefficients: `PPO`'s clip, value_clip, value_coef, entropy_coef and auxiliary_coef, numbers
            or tensors () on the device, which may change between replays of a graph.
    """
    clip, value_clip = coefficients["clip"], coefficients["value_clip"]
    valid = batch.valid
    log_ratio = logprobs - batch.logprobs
    log_ratio = log_ratio.masked_fill(~valid, 0.0)  # its exp may overflow, and 0 * inf is NaN
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - clip, 1 + clip)
    surrogate = torch.minimum(ratio * batch.advantages, clipped * batch.advantages)
    squared = ((values - batch.targets) / value_scale).square()
    if value_clip is not None:
        limit = value_clip * value_scale
        moved = batch.old_value + (values - batch.old_value).clamp(-limit, limit)
        squared = torch.maximum(squared, ((moved - batch.targets) / value_scale).square())
    policy = -masked_mean(surrogate, valid)
    value, entropy = masked_mean(squared, valid), masked_mean(entropies, valid)
    with torch.no_grad():
        # this estimate of the KL divergence is never negative, unlike the mean log ratio
        kl = masked_mean(ratio - 1 - log_ratio, valid)
        clip_fraction = masked_mean((ratio != clipped).float(), valid)
    loss = policy + coefficients["value_coef"] * value - coefficients["entropy_coef"] * entropy
    metrics = dict(policy=policy, value=value, entropy=entropy, kl=kl, clip_fraction=clip_fraction)
    if errors is not None:
        metrics["auxiliary"] = masked_mean(errors, valid)
        loss = loss + coefficients["auxiliary_coef"] * metrics["auxiliary"]
    return loss, metrics


@fused(_joint_loss, _takes_joint_loss)
def _loss_of(policy, batch, coefficients, has_errors, obs, privileged, lanes) -> tuple:
    """Returns the loss of a minibatch, its metrics, and the features that it learns from."""
    options = dict(has_errors=has_errors, mask=without_last(batch.get("mask")))
    sequence = obs, without_last(batch.starts), batch.state, batch.actions
    terms = policy.terms(*sequence, privileged, lanes, **options)
    features, scale = terms.pop("features"), policy.critic.output.scale
    loss = ppo_loss(**terms, batch=batch, value_scale=scale, coefficients=coefficients)
    return *loss, features


class PPO(learner.ActorCritic):
    """Improves a policy, in place, from rollouts that it collected.

    Args:
        clip: how far the probability ratio of an action may move from 1 before its gradient stops.
        value_clip: how far the value may move from that at the time of acting before its gradient
            stops, in the value's own scale (as in OpenAI Baselines). None: any distance.
        normalise_advantage: over what advantages get mean 0 and standard deviation 1: "rollout",
            "minibatch", or "none", which leaves them in units of reward.
        target_kl: ends an update early, once the KL divergence of a minibatch from the acting
            policy exceeds this many nats. None: never.

    Metrics:
        loss/clip_fraction: fraction of ratios beyond `clip`.

    Other arguments and metrics are those of `ActorCritic` and `GradientLearner`.
    """

    @checked
    def __init__(
        self,
        policy: Policy,
        *,
        clip: learner.ScheduledPositive = 0.2,
        value_clip: learner.Positive | None = None,
        normalise_advantage: Literal["rollout", "minibatch", "none"] = "rollout",
        target_kl: learner.Positive | None = None,
        **settings,
    ):
        self.loss_coefficients = dict(clip=clip)
        super().__init__(policy, **settings)
        self.value_clip, self.target_kl = value_clip, target_kl
        self.normalise_advantage = normalise_advantage

    def _update(self, rollout) -> "dict[str, torch.Tensor]":
        transitions = rollout.transitions()
        numbers = {name: self.coefficients[name] for name in ("gamma", "lambda_")}
        estimates = returns.gae(**transitions, learns=rollout.learns[:-1], **numbers)
        advantages, targets, valid = (estimates[key] for key in ("advantages", "targets", "valid"))
        moments = masked_moments(valid, targets, advantages)
        (_, _, variance), (_, _, error) = moments  # an advantage is the error of the value
        explained = 1 - error / torch.maximum(variance, 1e-8 * error).clamp(min=1e-30)
        # One row of observations is enough: every rollout brings another B.
        last = rollout.world(-1)
        own_obs = self.policy.moments(last.obs, last.get("privileged"), rollout.learns[-1])
        is_finite, pooled = self.steps.begin(rollout.floats(), *moments, *own_obs)
        of_targets, of_advantages, *of_obs = pooled
        self.critic.output.add(of_targets, is_finite)
        if self.normalise_advantage == "rollout":
            estimates["advantages"] = normalise_masked(advantages, valid, of_advantages)
        if self.value_clip is not None:
            estimates["old_value"] = transitions["value"]
        estimates["n_valid"] = valid.sum(0, keepdim=True)  # of each lane

        is_enabled = True
        for _ in range(self.n_epochs):
            for lanes in self.minibatches(rollout.n_lanes):
                parts = SEQUENCES if self.has_extra_loss else _PARTS
                batch = rollout.sequences(lanes, parts, estimates)
                batch["n_valid"] = batch.pop("n_valid").sum()
                if self.normalise_advantage == "minibatch":
                    batch["advantages"] = pooled_normalise(batch.advantages, batch.valid)
                loss, metrics = self._losses(rollout, lanes, batch)
                kl = self.steps.backward(loss, metrics, batch.n_valid)["kl"]
                if self.target_kl is not None:
                    is_enabled = is_enabled & ~(kl > self.target_kl)
                if self.desired_kl is not None:
                    self.steps.follow_kl(kl, self.desired_kl)
                self.steps.take(is_enabled)
        # Observation statistics change only now, so the whole update saw the normalisation that
        # acted.
        add_moments(self.policy.norms, of_obs, is_finite)
        return {**self.steps.end(), "explained_variance": explained}

    def _losses(self, rollout, lanes, batch) -> "tuple[torch.Tensor, dict[str, torch.Tensor]]":
        """Returns the loss of a minibatch and its metrics, (); `batch` has its other parts."""
        numbers: dict = {name: self.coefficients[name] for name in _COEFFICIENTS}
        numbers["value_clip"] = self.value_clip
        seen = without_last(rollout.obs), without_last(rollout.privileged), lanes
        inputs = self.policy, batch, numbers, not self.has_extra_loss
        loss, metrics, features = _loss_of(*inputs, *seen)
        if self.has_extra_loss:  # which has that of the privileged observations, too
            with self.policy.compute_dtype():
                extra, own = self.extra_terms(features, batch, metrics)
            loss, metrics = loss + extra, metrics | own
        return loss, metrics
