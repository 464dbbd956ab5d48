"""PPO's loss: the clipped objective, the value's error, the entropy bonus and the auxiliary error
(Schulman et al. 2017, eq. 7 and 9).

T time, M lanes of a minibatch.
"""

from typing import NamedTuple

import torch
from torch.autograd.function import once_differentiable

from megastep.agents.algorithms.kernels import LIBRARY
from megastep.agents.algorithms.masked_stats import masked_mean
from megastep.arrdict import arrdict
from megastep.coefficients import on_device
from megastep.kernels.build.launch import BLOCK, Blocks, launch

METRICS = "policy", "value", "entropy", "kl", "clip_fraction", "auxiliary"


class Coefficients(NamedTuple):
    """The settings of the loss; see `PPO`. Tensors () on the device may change between replays of a
    graph.
    """

    clip: float | torch.Tensor
    value_clip: float | None
    value_coef: float | torch.Tensor
    entropy_coef: float | torch.Tensor
    auxiliary_coef: float | torch.Tensor


def ppo_loss(
    logprobs: torch.Tensor,
    entropies: torch.Tensor,
    values: torch.Tensor,
    errors: torch.Tensor | None,
    batch: arrdict,
    value_scale: torch.Tensor,
    coefficients: Coefficients,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Returns the loss, a mean over the valid steps, and its metrics, tensors ().

    On a GPU one kernel computes both, and the gradients.

    Args:
        logprobs: (T, M) float32, of the actions.
        entropies: (T, M), of the policy.
        values: (T, M), in units of reward.
        errors: (T, M), of the auxiliary prediction, or None.
        batch: has `logprobs`, `advantages`, `targets` and `valid`, (T, M) each, and `n_valid` (),
            the number of valid steps; with a `value_clip` also `old_value` (T, M).
        value_scale: (), the value's own scale.
        coefficients: the settings.
    """
    if logprobs.is_cuda:
        inputs = logprobs, entropies, values, errors
        loss, means = _FusedLoss.apply(*inputs, batch, value_scale, coefficients)
        metrics: dict[str, torch.Tensor] = dict(zip(METRICS, means.unbind(), strict=True))
    else:
        loss, metrics = plain_loss(
            logprobs, entropies, values, errors, batch, value_scale, coefficients
        )
    if errors is None:
        metrics.pop("auxiliary", None)
    return loss, metrics


def plain_loss(
    logprobs, entropies, values, errors, batch, value_scale, coefficients
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Does the same in PyTorch."""
    clip, value_clip, value_coef, entropy_coef, auxiliary_coef = coefficients
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
    loss = policy + value_coef * value - entropy_coef * entropy
    metrics = dict(policy=policy, value=value, entropy=entropy, kl=kl, clip_fraction=clip_fraction)
    if errors is not None:
        metrics["auxiliary"] = masked_mean(errors, valid)
        loss = loss + auxiliary_coef * metrics["auxiliary"]
    return loss, metrics


class _FusedLoss(torch.autograd.Function):
    """`plain_loss` in one kernel, which leaves the gradients for the backward pass."""

    @staticmethod
    def forward(
        ctx, logprobs, entropies, values, errors, batch, value_scale, coefficients
    ) -> tuple[torch.Tensor, torch.Tensor]:
        numbers = coefficients._asdict()
        value_clip, device = numbers.pop("value_clip"), logprobs.device
        inputs = [None if x is None else x.contiguous() for x in (entropies, values, errors)]
        gradients = [logprobs.new_empty(logprobs.shape) for _ in range(3 + (errors is not None))]
        n_rows = logprobs.numel()
        blocks = Blocks(-(-n_rows // BLOCK))
        sums = logprobs.new_empty(blocks.x, LIBRARY.constants["N_SUMS"])
        names = "d_logprobs", "d_entropies", "d_values", "d_errors"
        launch(
            *(LIBRARY, "ppo_loss", device, blocks),
            logprobs=logprobs.contiguous(),
            **dict(zip(("entropies", "values", "errors"), inputs, strict=True)),
            old_logprobs=batch.logprobs.contiguous(),
            old_values=None if value_clip is None else batch.old_value.contiguous(),
            advantages=batch.advantages.contiguous(),
            targets=batch.targets.contiguous(),
            valid=batch.valid.contiguous(),
            n_valid=batch.n_valid,
            value_scale=value_scale,
            **{**dict.fromkeys(names), **dict(zip(names, gradients))},
            sums=sums,
            **{name: on_device(number, device) for name, number in numbers.items()},
            n_rows=n_rows,
            value_clip=value_clip or 0.0,
        )
        ctx.save_for_backward(*gradients)
        means = sums.sum(0)
        metrics, loss = means[:-1], means[-1]
        ctx.mark_non_differentiable(metrics)
        return loss, metrics

    @staticmethod
    @once_differentiable
    def backward(ctx, d_loss, d_metrics) -> tuple[torch.Tensor | None, ...]:
        # Learners differentiate the loss itself, so that d_loss is 1; others may scale it
        gradients = torch._foreach_mul(ctx.saved_tensors, d_loss)  # pyright: ignore[reportPrivateImportUsage]
        return *gradients, *[None] * (7 - len(gradients))
