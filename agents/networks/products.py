"""The matrix products of layers and of their gradients: those of few rows on a GPU by kernels of
our own, see `megastep.agents.networks.kernels.few_rows`, and others by PyTorch. Gradients of
weights are always by PyTorch, which splits the rows that they add up.

N rows, K inputs, M outputs; `...` any leading axes. All matrices of a product have one dtype.
"""

import torch

from megastep.agents.networks.kernels import few_rows


def layer(
    x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, has_relu: bool = False
) -> torch.Tensor:
    """Returns the outputs (..., M) of a linear layer.

    Args:
        x: (..., K).
        weight: (M, K).
        bias: (M,).
        has_relu: applies a ReLU.
    """
    rows = x.flatten(0, -2)
    if few_rows.is_supported(rows, weight) and not len(weight) % 8 and bias.is_contiguous():
        outputs = few_rows.layer(rows, weight, bias, has_relu)
    elif has_relu:
        outputs = torch._addmm_activation(bias, rows, weight.T)  # pyright: ignore[reportPrivateImportUsage]
    else:
        outputs = torch.addmm(bias, rows, weight.T)
    return outputs.unflatten(0, x.shape[:-1])


def add_layer(outputs: torch.Tensor, x: torch.Tensor, weight: torch.Tensor) -> None:
    """Adds x (N, K) times a weight (M, K) to outputs (N, M), in place."""
    if few_rows.is_supported(x, weight, outputs):
        few_rows.layer(x, weight, onto=outputs)
    else:
        outputs.addmm_(x, weight.T)


def of_inputs(
    d: torch.Tensor, weight: torch.Tensor, addend: torch.Tensor | None = None
) -> torch.Tensor:
    """Returns the gradient (..., K) of a layer's inputs, plus an addend of that shape.

    Args:
        d: (..., M), that of its outputs.
        weight: (M, K).
        addend: (..., K), contiguous; None: nothing.
    """
    rows = d.flatten(0, -2)
    flat = None if addend is None else addend.flatten(0, -2)
    addends = () if flat is None else (flat,)
    if few_rows.is_supported(rows, weight, *addends) and all(x.is_contiguous() for x in addends):
        result = few_rows.of_inputs(rows, weight, flat)
    else:
        result = rows @ weight if flat is None else torch.addmm(flat, rows, weight)
    return result.unflatten(0, d.shape[:-1])


def of_weights(d: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Returns the gradient (M, K) float32 of a layer's weights. A GPU does not round it to the
    matrices' dtype.

    Args:
        d: (N, M), that of its outputs.
        x: (N, K), its inputs.
    """
    if d.is_cuda and d.dtype != torch.float32:
        return torch.mm(d.T, x, out_dtype=torch.float32)
    return (d.T @ x).float()
