"""The critic: predicts the return from the actor's features and from privileged observations. And
the heads of an update together: actions, value and auxiliary prediction from the same features, on
a GPU one product and one kernel.

N rows, `...` any leading axes, such as (B,) lanes or (T, B) time and lanes; W width, A agents that
one lane controls, n choices, F predicted features. A row of the product has the prediction, the
actions' scores, and the critic's hidden layer before its ReLU, each padded to a multiple of 8.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep.agents.networks import side_stream
from megastep.agents.networks.fused import LIBRARY, aligned, fused
from megastep.agents.networks.heads import MultiDiscreteOutput, Output
from megastep.agents.networks.intakes import ConcatIntake
from megastep.agents.networks.linear import (
    bias_gradient,
    cast,
    compute_dtype,
    gradient_of_inputs,
    gradient_of_weights,
    linear,
    product,
    sum_rows,
)
from megastep.agents.networks.value_output import ValueOutput
from megastep.kernels.build.launch import WARP, Blocks, launch
from megastep.types import Space, Tree

Terms = tuple[torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor]
# Rows that a block of the heads' kernels adds up, or handles going forward, and its threads.
_STRIP, _ROWS, _STRIP_THREADS = (
    LIBRARY.constants[name] for name in ("STRIP", "HEADS_ROWS", "STRIP_THREADS")
)
_MULTIPLE = 8  # of which widths are multiples where a kernel computes values


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


def _launch_heads(first, hidden, value, sizes, **fields) -> None:
    """Computes what follows from a product (N, columns) bfloat16, of which `hidden` are the last
    columns: `values` (N,) float32 and others of the kernel's fields.
    """
    names = "target", "actions", "logprobs", "entropies", "errors"
    launch(
        *(LIBRARY, "heads_forward", hidden.device),
        Blocks(-(-len(hidden) // _ROWS), threads=_STRIP_THREADS),
        **{**dict.fromkeys(names), **fields, **value},
        **_product(first, hidden),
        **sizes._asdict(),
    )


def _product(first, hidden) -> dict[str, object]:
    """Returns the kernels' fields of a product; `first` are its columns before `hidden`."""
    stride = 0 if first is None else first.stride(0)
    strides = dict(product_stride=stride, hidden_stride=hidden.stride(0))
    return dict(product=first, hidden=hidden, n_rows=len(hidden), **strides)


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
    sizes = _Sizes(width=rows.shape[1])
    _launch_heads(None, rows, _value_parameters(critic.output), sizes, values=values)
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


class Started(NamedTuple):
    """What heads compute of weights and privileged observations, before there are features."""

    target: torch.Tensor  # (N, F padded), of the prediction: encoded observations
    projected: torch.Tensor  # (N, W)
    hidden: torch.Tensor  # (N, W), of the hidden layer's product the part of `projected`
    of_privileged: torch.Tensor  # (W, W), weight of that part
    weight: torch.Tensor  # (columns, W), of the features
    bias: torch.Tensor  # of the columns before the hidden layer


def _layers(output, critic, prediction) -> list[nn.Linear]:
    """Returns what reads the features, in the order of the product's columns."""
    return [prediction, output.linear, critic.hidden] if prediction else [output.linear]


@torch.no_grad()
def start_heads(
    output: Output,
    critic: Critic,
    prediction: nn.Linear | None,
    encode: Callable[[], torch.Tensor | None],
    mask: Tree = None,
) -> tuple[torch.Tensor | None, Started | None]:
    """Returns `encoded` and `started` as `head_terms` takes them; `encode` computes the former."""
    if not critic.is_asymmetric or not _has_joint(output, critic, prediction, mask):
        return encode(), None
    project = critic.intake.project
    is_bf16 = project.weight.is_cuda and compute_dtype(project.weight) == torch.bfloat16
    if not is_bf16 or len(project.weight) % _MULTIPLE:
        return encode(), None
    weights, biases = (
        [cast(leaf, torch.bfloat16, _MULTIPLE) for leaf in leaves]
        for leaves in zip(*((x.weight, x.bias) for x in _layers(output, critic, prediction)))
    )
    weights[2], of_privileged = weights[2].split(len(weights[2]), 1)
    # First what takes no time: a sequence that starts now finds the GPU free.
    weight, bias, encoded = torch.cat(weights), torch.cat(biases[:2]), encode()
    assert encoded is not None
    rows, own = aligned(encoded.flatten(0, -2)), (project.weight, project.bias)
    projected = product(rows, *(cast(leaf, rows.dtype) for leaf in own), has_relu=True)
    hidden = product(projected, of_privileged, biases[2])
    return encoded, Started(rows, projected, hidden, of_privileged, weight, bias)


class _JointHeads(torch.autograd.Function):
    """Weights of what reads the features, one above the other, make one product (rows, columns).
    Its gradient is one tensor, too, so that those of the features need no sum. A plain critic has
    neither a target nor privileged observations.
    """

    @staticmethod
    def forward(
        ctx, sizes, value, started, actions, features, *parameters
    ) -> tuple[torch.Tensor, ...]:
        lead, dtype = features.shape[:-1], features.dtype
        features, actions = aligned(features.flatten(0, -2)), aligned(actions.flatten(0, -2).long())
        names, target, others = ["logprobs", "entropies", "values"], None, ()
        if started is None:
            weight = torch.cat([cast(leaf, dtype, _MULTIPLE) for leaf in parameters[::2]])
            bias = torch.cat([cast(leaf, dtype, _MULTIPLE) for leaf in parameters[1::2]])
            first = product(features, weight, bias)
            hidden = first[:, sizes.first_hidden :]
        else:
            names.append("errors")
            target, projected, hidden, of_privileged, weight, bias = started
            of_first, of_hidden = weight.split([len(bias), sizes.width])
            others, first = (projected, of_privileged), product(features, of_first, bias)
            product(features, of_hidden, None, onto=hidden)
        results = hidden.new_empty(len(names), len(hidden), dtype=torch.float32).unbind()
        inputs = dict(target=target, actions=actions, **dict(zip(names, results, strict=True)))
        _launch_heads(first, hidden, value, sizes, **inputs)
        ctx.sizes = sizes
        ctx.save_for_backward(
            *(features, weight, first, hidden, target, actions),
            *(value["value_weight"], value["value_scale"], *others),
        )
        return tuple(each.view(lead) for each in results)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients) -> tuple[torch.Tensor | None, ...]:
        features, weight, first, hidden, target, actions, *saved = ctx.saved_tensors
        value_weight, value_scale, *others = saved
        sizes, lead, n_rows, n_columns = ctx.sizes, gradients[0].shape, len(hidden), len(weight)
        n_strips = -(-n_rows // _STRIP)
        n_parts = 1 + -(-sizes.width // (_MULTIPLE * WARP))
        d = hidden.new_empty(n_rows, n_columns)
        sum_sizes = n_columns, sizes.width, _MULTIPLE
        sums = hidden.new_empty(n_strips, sum(sum_sizes), dtype=torch.float32)
        names = "d_logprobs", "d_entropies", "d_values", "d_errors"
        launch(
            *(LIBRARY, "heads_backward", hidden.device),
            Blocks(n_strips * n_parts, threads=_STRIP_THREADS),
            **dict(_product(first, hidden), target=target, actions=actions),
            **dict(value_weight=value_weight, value_scale=value_scale),
            **{**dict.fromkeys(names), **dict(zip(names, (d.contiguous() for d in gradients)))},
            **dict(d_product=d, sums=sums, **sizes._asdict()),
        )
        # first what the core's sequence waits for
        d_features = side_stream.mark_ready(gradient_of_inputs(d, weight).unflatten(0, lead))
        d_biases, d_value_weight, d_value_bias = sum_rows(sums).split(sum_sizes)
        d_weight, first_hidden = gradient_of_weights(d, features), sizes.first_hidden
        n_scores = sizes.n_agents * sizes.n_choices
        scores = slice(sizes.first_score, sizes.first_score + n_scores)
        d_scores = d_weight[scores], d_biases[scores]
        if target is None:
            value = slice(first_hidden, first_hidden + 1)
            d_value = d_weight[value], d_biases[value]
            return *(None, None, None, None), d_features, *d_scores, *d_value
        (projected, of_privileged), d_hidden = others, d[:, first_hidden:]
        d_of_privileged = gradient_of_weights(d_hidden, projected)
        d_projected = gradient_of_inputs(d_hidden, of_privileged)
        d_projected, d_project_bias = bias_gradient(d_projected, projected)
        return (
            *(None, None, None, None, d_features),
            *(d_weight[: sizes.n_predicted], d_biases[: sizes.n_predicted], *d_scores),
            *(torch.cat([d_weight[first_hidden:], d_of_privileged], 1), d_biases[first_hidden:]),
            *(d_value_weight[None], d_value_bias[:1]),
            *(gradient_of_weights(d_projected, target), d_project_bias),
        )


def _terms_on_gpu(
    output, critic, prediction, features, encoded, actions, mask=None, started=None
) -> Terms:
    (n_agents, n_choices), has_hidden = output.shape, critic.is_asymmetric
    layers, sizes = _layers(output, critic, prediction), _Sizes(0, n_agents, n_choices, _MULTIPLE)
    layers.append(critic.output.linear)
    if has_hidden:
        sizes = _Sizes(len(prediction.weight), n_agents, n_choices, features.shape[-1])
        layers.append(critic.intake.project)
    parameters = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
    inputs = _value_parameters(critic.output, has_hidden), started, actions, features
    logprobs, entropies, values, *errors = _JointHeads.apply(sizes, *inputs, *parameters)
    return logprobs, entropies, errors[0] if errors else None, values


def _has_joint(output, critic, prediction, mask) -> bool:
    is_known = type(output) is MultiDiscreteOutput and mask is None
    return is_known and critic.is_asymmetric == (prediction is not None)


def _fits_joint(
    output, critic, prediction, features, encoded, actions, mask=None, started=None
) -> bool:
    is_known = _has_joint(output, critic, prediction, mask)
    if not is_known or critic.is_asymmetric != (started is not None):
        return False
    is_bf16 = features.is_cuda and features.dtype == torch.bfloat16
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
    started: Started | None = None,
) -> Terms:
    """Returns log-probabilities of actions (..., A), entropies, squared errors of the prediction
    and values from features (..., W), (...,) float32 each. `encoded` (..., columns) is what the
    critic's `encode` returned; without a prediction of it the errors are None. `started`, what
    `start_heads` returned, is overwritten.
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
