"""The critic: predicts the return from the actor's features and from privileged observations, in
numbers normalised by running statistics of returns (PopArt). And the heads of an update together:
actions, value and auxiliary prediction from the same features, on a GPU one product and one kernel.

N rows, `...` any leading axes, such as (B,) lanes or (T, B) time and lanes; W width, A agents that
one lane controls, n choices, F predicted features. A row of the product has the prediction, the
actions' scores, and the critic's hidden layer before its ReLU, each padded to a multiple of 8.
"""

from typing import NamedTuple

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep.agents.distributed.pooling import pool_moments
from megastep.agents.networks.fused import LIBRARY, aligned, fused, is_plain_on_gpu
from megastep.agents.networks.heads import MultiDiscreteOutput, Output
from megastep.agents.networks.intakes import ConcatIntake
from megastep.agents.networks.linear import (
    cast,
    compute_dtype,
    gradient_of_inputs,
    gradient_of_weights,
    linear,
    product,
    sum_rows,
)
from megastep.agents.networks.running_norm import RESOLUTION, masked_moments, mix_moments, store_if
from megastep.agents.types import Moments
from megastep.kernels.build.launch import WARP, Blocks, launch
from megastep.types import Space, Tree

Terms = tuple[torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor]
# Rows that a block of the heads' kernels adds up, and its threads.
_STRIP, _STRIP_THREADS = LIBRARY.constants["STRIP"], LIBRARY.constants["STRIP_THREADS"]
_MULTIPLE = 8  # of which widths are multiples where a kernel computes values
_THREADS = LIBRARY.constants["MASKED_THREADS"]
_MIN_RATE = 0.05  # smallest weight of a rollout's returns in their statistics
_MIN_SCALE = 1e-15  # far below the standard deviation of returns in any units, and not 0


def _add_on_gpu(output, moments, is_counted=None) -> None:
    n_valid, mean, variance = moments
    launch(
        *(LIBRARY, "add_returns", output.mean.device, Blocks(1, threads=_THREADS)),
        **dict(weight=output.linear.weight, bias=output.linear.bias),
        **dict(mean=output.mean, scale=output.scale, count=output.count),
        **dict(new_mean=mean, new_variance=variance, n_valid=n_valid, is_counted=is_counted),
        **dict(width=output.linear.in_features, min_rate=_MIN_RATE, min_scale=_MIN_SCALE),
    )


class ValueOutput(nn.Module):
    """Predicts the return: (..., width) -> (...,) float32, in units of reward.

    The linear layer predicts returns normalised by their running mean and standard deviation, so
    its error is about 1 whatever the size of rewards. `update_stats` moves both statistics and
    corrects the layer so that no prediction changes (PopArt, van Hasselt et al. 2016).
    """

    mean: torch.Tensor  # ()
    scale: torch.Tensor
    count: torch.Tensor

    def __init__(self, width: int):
        super().__init__()
        self.linear = nn.Linear(width, 1)
        nn.init.orthogonal_(self.linear.weight, gain=0.1)
        nn.init.zeros_(self.linear.bias)
        for name, start in dict(mean=0.0, scale=1.0, count=0.0).items():
            self.register_buffer(name, torch.tensor(start))

    @torch.no_grad()
    def clear(self) -> None:
        """Makes predictions 0, unless there are statistics of returns: those of a new network may
        be many times the size of returns, and PopArt would keep them.
        """
        for parameter in self.linear.parameters():
            parameter.masked_fill_(self.count == 0, 0.0)

    @property
    def is_clear(self) -> torch.Tensor:
        """Whether there have been no statistics since `clear`: () bool."""
        return (self.count == 0) & ~self.linear.weight.any() & ~self.linear.bias.any()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        normalised = linear(x, self.linear).float().squeeze(-1)
        return normalised * self.scale + self.mean

    def update_stats(self, targets: torch.Tensor, valid: torch.Tensor) -> None:
        """Adds valid returns (...,) to the statistics, those of all ranks together; see `add`."""
        (moments,) = pool_moments(*masked_moments(valid, targets))
        self.add(moments)

    @torch.no_grad()
    @fused(_add_on_gpu, lambda self, *_: is_plain_on_gpu(self.mean, *self.linear.parameters()))
    def add(self, moments: Moments, is_counted: torch.Tensor | None = None) -> None:
        """Adds moments of returns to the statistics, the n-th call with weight max(0.05, 1/n).
        Changes nothing if there is no return, if mean or variance is not finite, if all returns
        have been 0, which tells nothing about their size, or if `is_counted`, () bool, is false.
        """
        n_valid, mean, variance = moments
        count = self.count + 1
        rate = (1 / count).clamp(min=_MIN_RATE, max=1.0)
        mean, scale = mix_moments(self.mean, self.scale, mean, variance, rate)
        is_nothing = (self.count == 0) & (scale == 0) & (mean == 0)
        scale = torch.maximum(scale, (RESOLUTION * mean.abs()).clamp(min=_MIN_SCALE))
        weight = self.linear.weight * (self.scale / scale)
        bias = (self.linear.bias * self.scale + (self.mean - mean)) / scale
        is_stored = (n_valid > 0) & (mean + scale).isfinite() & ~is_nothing
        if is_counted is not None:
            is_stored = is_stored & is_counted
        old = self.linear.weight, self.linear.bias, self.mean, self.scale, self.count
        store_if(is_stored, zip(old, (weight, bias, mean, scale, count), strict=True))


# ---- Values, and heads together, by kernels ----


class _Sizes(NamedTuple):
    """The columns of the product of heads. Values alone have only those of the hidden layer. A
    plain critic has a word with its value in place of that layer.
    """

    n_predicted: int = 0  # F
    n_agents: int = 0
    n_choices: int = 0
    width: int = 0

    @property
    def first_score(self) -> int:
        return self.n_predicted + -self.n_predicted % _MULTIPLE

    @property
    def first_hidden(self) -> int:
        n_scores = self.n_agents * self.n_choices
        return self.first_score + n_scores + -n_scores % _MULTIPLE


def _launch_heads(columns, value, sizes, **fields) -> None:
    """Computes what follows from a product (N, columns) bfloat16: `values` (N,) float32 and others
    of the kernel's fields.
    """
    names = "target", "actions", "logprobs", "entropies", "errors"
    launch(
        *(LIBRARY, "heads_forward", columns.device),
        Blocks(-(-len(columns) // _STRIP), threads=_STRIP_THREADS),
        **{**dict.fromkeys(names), **fields, **value},
        **dict(product=columns, n_rows=len(columns), **sizes._asdict()),
    )


def _value_parameters(output, has_hidden=True) -> dict[str, torch.Tensor | None]:
    weight, bias = None, None
    if has_hidden:
        weight, bias = (leaf.detach() for leaf in output.linear.parameters())
        weight = aligned(weight)
    statistics = dict(value_scale=output.scale, value_mean=output.mean)
    return dict(value_weight=weight, value_bias=bias, **statistics)


def _are_few_words(x) -> bool:
    n_rows = x.numel() // max(x.shape[-1], 1)
    return 0 < n_rows <= 2**31 - _STRIP and not x.shape[-1] % _MULTIPLE


def _value_on_gpu(critic, joined) -> torch.Tensor:
    hidden = linear(joined, critic.hidden)
    rows = aligned(hidden.flatten(0, -2))
    values = rows.new_empty(len(rows), dtype=torch.float32)
    _launch_heads(
        rows, _value_parameters(critic.output), _Sizes(width=rows.shape[1]), values=values
    )
    return values.view(hidden.shape[:-1])


def _fits_value(critic, joined) -> bool:
    weight, features = critic.output.linear.weight, joined[0]
    is_bf16 = features.is_cuda and compute_dtype(weight) == torch.bfloat16
    is_known = is_bf16 and weight.dtype == torch.float32 and not torch.is_grad_enabled()
    return is_known and _are_few_words(features)


class Critic(nn.Module):
    """Predicts the return: features (..., width) -> (...,) float32, in units of reward.

    With a `privileged_space` the critic is asymmetric (Pinto et al. 2018): it encodes the
    privileged observation into `width` more features, and a hidden layer joins both.
    """

    def __init__(self, width: int, privileged_space: Space | None = None):
        super().__init__()
        self.is_asymmetric = privileged_space is not None
        if self.is_asymmetric:
            self.intake = ConcatIntake(privileged_space, width)
            self.hidden = nn.Linear(2 * width, width)
            nn.init.orthogonal_(self.hidden.weight, gain=2**0.5)
            nn.init.zeros_(self.hidden.bias)
        self.output = ValueOutput(width)

    def encode(
        self, privileged: Tree | None, lanes: torch.Tensor | None = None
    ) -> torch.Tensor | None:
        """Returns the intake's `encode` of privileged observations (..., *shape), of which `lanes`
        (M,) int64 selects some lanes (T, B, ...). None of a plain critic.
        """
        return self.intake.encode(privileged, lanes) if self.is_asymmetric else None

    def forward(self, features: torch.Tensor, encoded: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the value from features (..., width) and what `encode` returned."""
        if not self.is_asymmetric:
            return self.output(features)
        assert encoded is not None
        return self._value((features, linear(encoded, self.intake.project, self.intake.activation)))

    @fused(_value_on_gpu, _fits_value)
    def _value(self, joined) -> torch.Tensor:
        """Returns the value (...,) from features and projected privileged observations."""
        return self.output(linear(joined, self.hidden, torch.relu))


# ---- Heads together ----


class _JointHeads(torch.autograd.Function):
    """Weights of what reads the features, one above the other, make one product (rows, columns).
    Its gradient is one tensor, too, so that those of the features need no sum. A plain critic has
    neither a target nor privileged observations.
    """

    @staticmethod
    def forward(
        ctx, sizes, value, target, actions, features, privileged, *parameters
    ) -> tuple[torch.Tensor, ...]:
        lead, dtype = features.shape[:-1], features.dtype
        features, actions = aligned(features.flatten(0, -2)), aligned(actions.flatten(0, -2).long())
        names, is_plain = ["logprobs", "entropies", "values"], privileged is None
        of_features = parameters if is_plain else parameters[:6]
        weights = [cast(weight, dtype, _MULTIPLE) for weight in of_features[::2]]
        biases = [cast(bias, dtype, _MULTIPLE) for bias in of_features[1::2]]
        of_privileged = None
        if not is_plain:
            names.append("errors")
            privileged, target = (aligned(leaf.flatten(0, -2)) for leaf in (privileged, target))
            weights[2], of_privileged = weights[2].split(sizes.width, 1)
        weight = torch.cat(weights)
        columns = product(features, weight, torch.cat(biases))
        if of_privileged is not None:
            product(privileged, of_privileged, None, onto=columns[:, sizes.first_hidden :])
        results = columns.new_empty(len(names), len(columns), dtype=torch.float32).unbind()
        inputs = dict(target=target, actions=actions)
        _launch_heads(columns, value, sizes, **inputs, **dict(zip(names, results, strict=True)))
        ctx.sizes = sizes
        ctx.save_for_backward(
            *(features, privileged, weight, of_privileged),
            *(columns, target, actions, value["value_weight"], value["value_scale"]),
        )
        return tuple(each.view(lead) for each in results)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients) -> tuple[torch.Tensor | None, ...]:
        features, privileged, weight, of_privileged, *saved = ctx.saved_tensors
        columns, target, actions, value_weight, value_scale = saved
        sizes, lead, (n_rows, n_columns) = ctx.sizes, gradients[0].shape, columns.shape
        n_strips = -(-n_rows // _STRIP)
        n_parts = 1 + -(-sizes.width // (_MULTIPLE * WARP))
        d = torch.empty_like(columns)
        sum_sizes = n_columns, sizes.width, _MULTIPLE
        sums = columns.new_empty(n_strips, sum(sum_sizes), dtype=torch.float32)
        names = "d_logprobs", "d_entropies", "d_values", "d_errors"
        launch(
            *(LIBRARY, "heads_backward", columns.device),
            Blocks(n_strips * n_parts, threads=_STRIP_THREADS),
            **dict(product=columns, target=target, actions=actions),
            **dict(value_weight=value_weight, value_scale=value_scale),
            **{**dict.fromkeys(names), **dict(zip(names, (d.contiguous() for d in gradients)))},
            **dict(d_product=d, sums=sums, n_rows=n_rows, **sizes._asdict()),
        )
        d_biases, d_value_weight, d_value_bias = sum_rows(sums).split(sum_sizes)
        d_weight, first_hidden = gradient_of_weights(d, features), sizes.first_hidden
        d_features = gradient_of_inputs(d, weight).unflatten(0, lead)
        n_scores = sizes.n_agents * sizes.n_choices
        scores = slice(sizes.first_score, sizes.first_score + n_scores)
        d_scores = d_weight[scores], d_biases[scores]
        if privileged is None:
            value = slice(first_hidden, first_hidden + 1)
            d_value = d_weight[value], d_biases[value]
            return *(None, None, None, None), d_features, None, *d_scores, *d_value
        d_hidden = d[:, first_hidden:]
        d_of_privileged = gradient_of_weights(d_hidden, privileged)
        return (
            *(None, None, None, None, d_features),
            gradient_of_inputs(d_hidden, of_privileged).unflatten(0, lead),
            *(d_weight[: sizes.n_predicted], d_biases[: sizes.n_predicted], *d_scores),
            *(torch.cat([d_weight[first_hidden:], d_of_privileged], 1), d_biases[first_hidden:]),
            *(d_value_weight[None], d_value_bias[:1]),
        )


def _terms_on_gpu(output, critic, prediction, features, encoded, actions, mask=None) -> Terms:
    (n_agents, n_choices), has_hidden = output.shape, critic.is_asymmetric
    layers, sizes = [output.linear], _Sizes(0, n_agents, n_choices, _MULTIPLE)
    target = privileged = None
    if has_hidden:
        layers = [prediction, output.linear, critic.hidden]
        sizes = _Sizes(len(prediction.weight), n_agents, n_choices, features.shape[-1])
        target, intake = encoded.detach(), critic.intake
        privileged = linear(encoded, intake.project, intake.activation)
    layers.append(critic.output.linear)
    parameters = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
    inputs = _value_parameters(critic.output, has_hidden), target, actions, features, privileged
    logprobs, entropies, values, *errors = _JointHeads.apply(sizes, *inputs, *parameters)
    return logprobs, entropies, errors[0] if errors else None, values


def _fits_joint(output, critic, prediction, features, encoded, actions, mask=None) -> bool:
    is_known = type(output) is MultiDiscreteOutput and mask is None
    if not is_known or critic.is_asymmetric != (prediction is not None):
        return False
    is_bf16 = features.is_cuda and features.dtype == torch.bfloat16
    is_bf16 = is_bf16 and (encoded is None or encoded.dtype == torch.bfloat16)
    is_float32 = critic.output.linear.weight.dtype == torch.float32
    return is_bf16 and is_float32 and _are_few_words(features)


@fused(_terms_on_gpu, _fits_joint)
def head_terms(
    output: Output,
    critic: Critic,
    prediction: nn.Linear | None,
    features: torch.Tensor,
    encoded: torch.Tensor | None,
    actions: Tree,
    mask: Tree = None,
) -> Terms:
    """Returns log-probabilities of actions (..., A), entropies, squared errors of the prediction
    and values from features (..., W), (...,) float32 each. `encoded` (..., columns) is what the
    critic's `encode` returned; without a prediction of it the errors are None.
    """
    errors = None
    if prediction is not None:
        assert encoded is not None
        errors = prediction_error(prediction, features, encoded)
    logits = output(features)
    logits = logits if mask is None else output.masked(logits, mask)
    logprobs, entropies = output.terms(logits, actions)
    return logprobs, entropies, errors, critic(features, encoded)


def prediction_error(
    prediction: nn.Linear, features: torch.Tensor, encoded: torch.Tensor
) -> torch.Tensor:
    """Returns the mean squared error (...,) of predicting the first columns of `encoded`."""
    target = encoded[..., : len(prediction.weight)].detach()
    return (linear(features, prediction).float() - target).square().mean(-1)
