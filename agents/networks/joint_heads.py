"""The heads of an update together: actions, value and auxiliary prediction from the same features.

On a GPU in bfloat16 they are one product, one kernel, and one sum of gradients.

N rows, `...` any leading axes, such as (T, B) time and lanes; W width, A agents that one lane
controls, n choices, F predicted features. A row of the product has the prediction, the actions'
scores, and the critic's hidden layer before its ReLU, each padded to a multiple of 8.
"""

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep.agents.networks.critic import (
    MULTIPLE,
    STRIP,
    STRIP_THREADS,
    Critic,
    HeadSizes,
    are_few_words,
    launch_heads,
    value_parameters,
)
from megastep.agents.networks.fused import LIBRARY, aligned, fused
from megastep.agents.networks.linear import (
    gradient_of_inputs,
    gradient_of_weights,
    linear,
    product,
    sum_rows,
)
from megastep.agents.networks.outputs import MultiDiscreteOutput, Output
from megastep.agents.networks.precision import cast
from megastep.kernels.build.launch import WARP, Blocks, launch
from megastep.types import Tree

Terms = tuple[torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor]


class _JointHeads(torch.autograd.Function):
    """Weights of what reads the features, one above the other, make one product (rows, columns).
    Its gradient is one tensor, too, so that those of the features need no sum.
    """

    @staticmethod
    def forward(
        ctx, sizes, value, target, actions, features, privileged, *parameters
    ) -> tuple[torch.Tensor, ...]:
        lead, dtype = features.shape[:-1], features.dtype
        features, privileged, target = (
            aligned(leaf.flatten(0, -2)) for leaf in (features, privileged, target)
        )
        actions = aligned(actions.flatten(0, -2).long())
        weights = [cast(weight, dtype, MULTIPLE) for weight in parameters[:6:2]]
        biases = [cast(bias, dtype, MULTIPLE) for bias in parameters[1:6:2]]
        of_features, of_privileged = weights[2].split(sizes.width, 1)
        weight = torch.cat([*weights[:2], of_features])
        columns = product(features, weight, torch.cat(biases))
        product(privileged, of_privileged, None, onto=columns[:, sizes.first_hidden :])
        results = columns.new_empty(4, len(columns), dtype=torch.float32).unbind()
        names = "logprobs", "entropies", "errors", "values"
        inputs = dict(target=target, actions=actions)
        launch_heads(columns, value, sizes, **inputs, **dict(zip(names, results, strict=True)))
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
        n_strips = -(-n_rows // STRIP)
        n_parts = 1 + -(-sizes.width // (MULTIPLE * WARP))
        d = torch.empty_like(columns)
        sum_sizes = n_columns, sizes.width, MULTIPLE
        sums = columns.new_empty(n_strips, sum(sum_sizes), dtype=torch.float32)
        names = "d_logprobs", "d_entropies", "d_errors", "d_values"
        launch(
            *(LIBRARY, "heads_backward", columns.device),
            Blocks(n_strips * n_parts, threads=STRIP_THREADS),
            **dict(product=columns, target=target, actions=actions),
            **dict(value_weight=value_weight, value_scale=value_scale),
            **dict(zip(names, (each.contiguous() for each in gradients), strict=True)),
            **dict(d_product=d, sums=sums, n_rows=n_rows, **sizes._asdict()),
        )
        d_biases, d_value_weight, d_value_bias = sum_rows(sums).split(sum_sizes)
        first_hidden = sizes.first_hidden
        d_hidden, d_weight = d[:, first_hidden:], gradient_of_weights(d, features)
        d_of_privileged = gradient_of_weights(d_hidden, privileged)
        n_scores = sizes.n_agents * sizes.n_choices
        scores = slice(sizes.first_score, sizes.first_score + n_scores)
        return (
            *(None, None, None, None),
            gradient_of_inputs(d, weight).unflatten(0, lead),
            gradient_of_inputs(d_hidden, of_privileged).unflatten(0, lead),
            *(d_weight[: sizes.n_predicted], d_biases[: sizes.n_predicted]),
            *(d_weight[scores], d_biases[scores]),
            *(torch.cat([d_weight[first_hidden:], d_of_privileged], 1), d_biases[first_hidden:]),
            *(d_value_weight[None], d_value_bias[:1]),
        )


def _terms_on_gpu(output, critic, prediction, features, encoded, actions, mask=None) -> Terms:
    sizes = HeadSizes(len(prediction.weight), output.shape[0], output.shape[1], features.shape[-1])
    inputs = features, critic.intake.projected(encoded)
    layers = prediction, output.linear, critic.hidden, critic.output.linear
    parameters = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
    value = value_parameters(critic.output)
    return _JointHeads.apply(sizes, value, encoded.detach(), actions, *inputs, *parameters)


def _fits(output, critic, prediction, features, encoded, actions, mask=None) -> bool:
    if prediction is None or mask is not None or type(output) is not MultiDiscreteOutput:
        return False
    is_bf16 = features.is_cuda and features.dtype == encoded.dtype == torch.bfloat16
    is_float32 = critic.output.linear.weight.dtype == torch.float32
    return is_bf16 and is_float32 and are_few_words(features)


@fused(_terms_on_gpu, _fits)
def head_terms(
    output: Output,
    critic: Critic,
    prediction: nn.Linear | None,
    features: torch.Tensor,
    encoded: torch.Tensor | None,
    actions: Tree,
    mask: Tree = None,
) -> Terms:
    """Returns log-probabilities of actions, entropies, squared errors of the prediction and values,
    (...,) float32 each.

    Args:
        output: of actions.
        critic: of values.
        prediction: predicts `encoded` from features. None: the errors are None.
        features: (..., W).
        encoded: (..., columns), what `critic.encode` returned; None for a plain critic.
        actions: (..., A).
        mask: (..., A, n) bool, allowed actions. None: all.
    """
    errors = None
    if prediction is not None:
        assert encoded is not None
        errors = prediction_error(prediction, features, encoded)
    logits = output(features)
    logits = logits if mask is None else output.masked(logits, mask)
    logprobs, entropies = output.terms(logits, actions)
    return logprobs, entropies, errors, critic.from_encoded(features, encoded)


def prediction_error(
    prediction: nn.Linear, features: torch.Tensor, encoded: torch.Tensor
) -> torch.Tensor:
    """Returns the mean squared error (...,) of predicting the first columns of `encoded`."""
    target = encoded[..., : len(prediction.weight)].detach()
    return (linear(features, prediction).float() - target).square().mean(-1)
