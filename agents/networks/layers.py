"""Layers with fused forms on a GPU.

Each has a plain form in PyTorch, which runs on a CPU, in float32 on a GPU, and for whatever the
fused form does not cover. Where bfloat16 is the compute dtype, the fused form runs: kernels of
`megastep.agents.networks.kernels.layers` around matrix products. Its weights' gradients
are float32 sums that are never rounded to bfloat16.

`...` any leading axes, such as (T, B) time and lanes.
"""

from collections.abc import Callable, Sequence

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep.agents.networks import linear_cpu, products
from megastep.agents.networks.kernels import layers as kernels
from megastep.agents.networks.kernels.library import aligned_rows
from megastep.agents.networks.precision import cast, compute_dtype
from megastep.agents.networks.running_norm import RunningNorm

Activation = Callable[[torch.Tensor], torch.Tensor]


def linear(
    x: torch.Tensor | tuple[torch.Tensor, torch.Tensor],
    layer: nn.Linear,
    activation: Activation | None = None,
) -> torch.Tensor:
    """Applies a linear layer and an activation in the compute dtype: (..., in) -> (..., out).

    Args:
        x: the input, or two parts of it, as if concatenated.
        layer: the layer.
        activation: such as `torch.relu`.
    """
    return affine(x, layer.weight, layer.bias, activation)


def affine(
    x: torch.Tensor | tuple[torch.Tensor, torch.Tensor],
    weight: torch.Tensor,
    bias: torch.Tensor | None,
    activation: Activation | None = None,
) -> torch.Tensor:
    """Does what `linear` does, for a weight (out, in) and a bias (out,)."""
    dtype = compute_dtype(weight)
    parts = [part.to(dtype) for part in (x if isinstance(x, tuple) else (x,))]
    is_known = activation in (None, torch.relu) and bias is not None
    is_aligned = not any(part.shape[-1] % 8 for part in parts)
    if parts[0].is_cuda and dtype == torch.bfloat16 and is_known and is_aligned:
        return _Linear.apply(weight, bias, activation is torch.relu, *parts)
    if bias is not None and is_known and linear_cpu.fits(weight, bias, *parts):
        return linear_cpu.CpuLinear.apply(weight, bias, activation is torch.relu, *parts)
    y = nn.functional.linear(torch.cat(parts, -1) if len(parts) > 1 else parts[0], weight, bias)
    return y if activation is None else activation(y)


class _Linear(torch.autograd.Function):
    """Adds the bias and the ReLU in the product's own kernel. Backward, one kernel masks the
    gradient and adds up its rows. Odd numbers of outputs are padded to a multiple of 8, as tensor
    cores want.
    """

    @staticmethod
    def forward(ctx, weight, bias, has_relu, *parts) -> torch.Tensor:
        ctx.n_outputs, ctx.has_relu, lead = len(weight), has_relu, parts[0].shape[:-1]
        dtype = parts[0].dtype
        weight, bias = (cast(leaf, dtype, multiple=8) for leaf in (weight, bias))
        parts = [part.flatten(0, -2) for part in parts]
        weights = weight.split([part.shape[1] for part in parts], 1)
        y = products.layer(parts[0], weights[0], bias, has_relu and len(parts) == 1)
        for part, its_weight in zip(parts[1:], weights[1:], strict=True):
            products.add_layer(y, part, its_weight)
        y = y.relu_() if has_relu and len(parts) > 1 else y
        ctx.save_for_backward(weight, *parts, *[y] * has_relu)
        return y[:, : ctx.n_outputs].unflatten(0, lead)

    @staticmethod
    @once_differentiable
    def backward(ctx, d) -> tuple[torch.Tensor | None, ...]:
        weight, *saved = ctx.saved_tensors
        parts, activated = (saved[:-1], saved[-1:]) if ctx.has_relu else (saved, [])
        lead, n_padding = d.shape[:-1], len(weight) - ctx.n_outputs
        d = nn.functional.pad(d.flatten(0, -2), (0, n_padding)) if n_padding else d.flatten(0, -2)
        d, d_bias = kernels.bias_gradient(aligned_rows(d), *activated)
        d_weight = None
        d_parts: list[torch.Tensor | None] = [None] * len(parts)
        if ctx.needs_input_grad[0]:
            d_weights = [products.of_weights(d, part) for part in parts]
            d_weight = torch.cat(d_weights, 1) if len(parts) > 1 else d_weights[0]
            d_weight = d_weight[: ctx.n_outputs]
        for i, its_weight in enumerate(weight.split([part.shape[1] for part in parts], 1)):
            if ctx.needs_input_grad[3 + i]:
                d_parts[i] = products.of_inputs(d, its_weight).unflatten(0, lead)
        return d_weight, d_bias[: ctx.n_outputs], None, *d_parts


def normalised(
    leaves: Sequence[torch.Tensor],
    norms: Sequence[RunningNorm],
    n_columns: int,
    lanes: torch.Tensor | None = None,
) -> torch.Tensor | None:
    """Returns leaves normalised, flattened and concatenated in one kernel, if the compute dtype is
    bfloat16; None where that is not possible.

    Args:
        leaves: (..., *shape) of each norm; (T, B, *shape) if there are lanes.
        norms: one per leaf.
        n_columns: of the result; those after the leaves' features are 0.
        lanes: (M,) int64, lanes to select.

    Returns:
        (..., n_columns), or (T, M, n_columns).
    """
    possible = compute_dtype(leaves[0]) == torch.bfloat16 and len(leaves) <= kernels.MAX_LEAVES
    possible = possible and (lanes is None or len(leaves[0]) <= kernels.MAX_STEPS)
    for leaf in leaves:
        is_float = leaf.dtype in (torch.float16, torch.float32) and not leaf.requires_grad
        possible = possible and leaf.is_cuda and leaf.is_contiguous() and is_float
    if not possible:
        return None
    flat = [leaf.flatten(-norm.mean.dim()) for leaf, norm in zip(leaves, norms, strict=True)]
    lead = flat[0].shape[:-1]
    if lanes is None:
        flat = [leaf.reshape(1, -1, leaf.shape[-1]) for leaf in flat]
    means, scales = [norm.mean for norm in norms], [norm.scale for norm in norms]
    features = kernels.normalise(flat, means, scales, n_columns, lanes)
    return features.view(*lead, n_columns) if lanes is None else features


class CategoricalTerms(torch.autograd.Function):
    """The log-probability of joint actions and the entropy (..., ) of log-probabilities
    (..., A, n), in one kernel each way.
    """

    @staticmethod
    def forward(ctx, logits, actions) -> tuple[torch.Tensor, ...]:
        lead = logits.shape[:-2]
        logits = logits.flatten(0, -3).contiguous()
        actions = actions.flatten(0, -2).long().contiguous()
        ctx.save_for_backward(logits, actions)
        return tuple(each.view(lead) for each in kernels.terms(logits, actions))

    @staticmethod
    @once_differentiable
    def backward(ctx, d_logprobs, d_entropies) -> tuple[torch.Tensor, None]:
        logits, actions = ctx.saved_tensors
        d = (d_logprobs.contiguous(), d_entropies.contiguous())
        d_logits = kernels.terms_backward(logits, actions, *d)
        return d_logits.unflatten(0, d_logprobs.shape), None
