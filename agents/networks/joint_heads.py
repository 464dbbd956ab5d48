"""The heads of an update together: actions, value and auxiliary prediction from the same features.

On a GPU in bfloat16 they are one product, one kernel, and one sum of gradients. The plain form is
in `Policy.terms`: it runs on a CPU, and for whatever does not fit.

`...` any leading axes, such as (T, B) time and lanes; W width, A agents that one lane controls.
"""

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep.agents.networks import products
from megastep.agents.networks.critic import Critic
from megastep.agents.networks.kernels import heads as kernels
from megastep.agents.networks.kernels.library import aligned
from megastep.agents.networks.outputs import MultiDiscreteOutput
from megastep.agents.networks.precision import cast


def fit(output: nn.Module, critic: Critic, features: torch.Tensor, encoded: torch.Tensor) -> bool:
    """Returns whether `joint_terms` takes these arguments."""
    on_gpu = features.is_cuda and features.dtype == encoded.dtype == torch.bfloat16
    is_known = type(output) is MultiDiscreteOutput and critic.is_asymmetric
    is_float32 = critic.output.linear.weight.dtype == torch.float32
    n_rows = features.numel() // max(features.shape[-1], 1)
    is_sized = 0 < n_rows <= kernels.MAX_ROWS and not features.shape[-1] % kernels.MULTIPLE
    return on_gpu and is_known and is_float32 and is_sized


def joint_terms(
    output: MultiDiscreteOutput,
    critic: Critic,
    prediction: nn.Linear,
    features: torch.Tensor,
    encoded: torch.Tensor,
    actions: torch.Tensor,
) -> tuple[torch.Tensor, ...]:
    """Returns log-probabilities of actions, entropies, squared errors of the prediction and values,
    (...,) float32 each.

    Args:
        output: of actions.
        critic: an asymmetric critic.
        prediction: predicts `encoded` from features.
        features: (..., W).
        encoded: (..., columns), what `critic.encode` returned.
        actions: (..., A).
    """
    sizes = kernels.Sizes(len(prediction.weight), *output.shape, features.shape[-1])
    inputs = features, critic.intake.projected(encoded)
    layers = prediction, output.linear, critic.hidden, critic.output.linear
    parameters = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
    value = critic.output.fused_value()
    return _JointHeads.apply(sizes, value, encoded.detach(), actions, *inputs, *parameters)


class _JointHeads(torch.autograd.Function):
    """Weights of what reads the features, one above the other, make one product (rows, columns).
    Its gradient is one tensor, too, so that those of the features need no sum.
    """

    @staticmethod
    def forward(
        ctx, sizes, value, target, actions, features, privileged, *parameters
    ) -> tuple[torch.Tensor, ...]:
        lead, dtype, width = features.shape[:-1], features.dtype, sizes.width
        features, privileged, target = (
            aligned(leaf.flatten(0, -2)) for leaf in (features, privileged, target)
        )
        actions = aligned(actions.flatten(0, -2).long())
        weights = [cast(weight, dtype, kernels.MULTIPLE) for weight in parameters[:6:2]]
        biases = [cast(bias, dtype, kernels.MULTIPLE) for bias in parameters[1:6:2]]
        of_features, of_privileged = weights[2].split(width, 1)
        weight = torch.cat([*weights[:2], of_features])
        columns = products.layer(features, weight, torch.cat(biases))
        products.add_layer(columns[:, sizes.starts[1] :], privileged, of_privileged)
        results = kernels.forward(columns, target, actions, value, sizes)
        ctx.sizes = sizes
        ctx.save_for_backward(
            *(features, privileged, weight, of_privileged), *(columns, target, actions), *value
        )
        return tuple(each.view(lead) for each in results)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients) -> tuple[torch.Tensor | None, ...]:
        features, privileged, weight, of_privileged, *saved = ctx.saved_tensors
        columns, target, actions, *value = saved
        sizes, lead = ctx.sizes, gradients[0].shape
        n_scores = sizes.n_agents * sizes.n_choices
        d, d_biases, d_value_weight, d_value_bias = kernels.backward(
            *(columns, target, actions, kernels.Value(*value), sizes),
            tuple(each.contiguous() for each in gradients),
        )
        first_score, first_hidden, _ = sizes.starts
        d_hidden = d[:, first_hidden:]
        d_weight = products.of_weights(d, features)
        d_hidden_weight = [d_weight[first_hidden:], products.of_weights(d_hidden, privileged)]
        scores = slice(first_score, first_score + n_scores)
        return (
            *(None, None, None, None),
            products.of_inputs(d, weight).unflatten(0, lead),
            products.of_inputs(d_hidden, of_privileged).unflatten(0, lead),
            *(d_weight[: sizes.n_predicted], d_biases[: sizes.n_predicted]),
            *(d_weight[scores], d_biases[scores]),
            *(torch.cat(d_hidden_weight, 1), d_biases[first_hidden:]),
            *(d_value_weight, d_value_bias),
        )
