"""Linear layers on a CPU: float32 matrix products by a kernel, which divides large ones among the
engine's threads. `torch.nn.functional.linear` is the same in PyTorch.
"""

import torch
from torch.autograd.function import once_differentiable

from megastep.agents.networks.kernels.library import LIBRARY, is_built_for_cpu
from megastep.engine.devices import threads
from megastep.kernels.build.launch import launch

MIN_OUTPUTS = 16  # of a layer; PyTorch takes less time for fewer, such as actions and values


def fits(weight: torch.Tensor, *others: torch.Tensor) -> bool:
    """Returns whether the kernel can take a layer's tensors, which needs a C++ compiler, and takes
    less time than PyTorch.
    """
    tensors = weight, *others
    is_float = all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)
    return is_float and len(weight) >= MIN_OUTPUTS and is_built_for_cpu()


def matmul(
    a: torch.Tensor,
    b: torch.Tensor,
    out: torch.Tensor | None = None,
    bias: torch.Tensor | None = None,
    adds: bool = False,
    has_relu: bool = False,
) -> torch.Tensor:
    """Returns the product of (rows, depth) and (depth, columns), of any strides, without a
    gradient.

    Args:
        a, b: the matrices, float32 on the CPU.
        out: where to write it, (rows, columns) with contiguous rows. None: a new tensor.
        bias: (columns,) to add.
        adds: adds to what `out` holds.
        has_relu: applies a ReLU at the end.
    """
    if out is None:
        out = torch.empty(len(a), b.shape[1])
    launch(
        *(LIBRARY, "matmul", a.device, 0),
        a=a,
        b=b,
        bias=None if bias is None else bias.contiguous(),
        out=out,
        a_row=a.stride(0),
        a_column=a.stride(1),
        b_row=b.stride(0),
        b_column=b.stride(1),
        out_row=out.stride(0),
        n_rows=len(a),
        n_columns=b.shape[1],
        depth=len(b),
        adds=adds,
        has_relu=has_relu,
        n_threads=threads(),
    )
    return out


class CpuLinear(torch.autograd.Function):
    """A linear layer, with a ReLU: parts (..., in) that count as concatenated -> (..., out)."""

    @staticmethod
    def forward(ctx, weight, bias, has_relu, *parts) -> torch.Tensor:
        ctx.has_relu, lead, last = has_relu, parts[0].shape[:-1], len(parts) - 1
        parts = [part.reshape(-1, part.shape[-1]) for part in parts]
        weights = weight.split([part.shape[1] for part in parts], 1)
        out = torch.empty(len(parts[0]), len(weight))
        for i, (part, its_weight) in enumerate(zip(parts, weights, strict=True)):
            its_bias = bias if i == 0 else None
            matmul(part, its_weight.T, out, its_bias, adds=i > 0, has_relu=has_relu and i == last)
        ctx.save_for_backward(weight, *parts, *[out] * has_relu)
        return out.view(*lead, len(weight))

    @staticmethod
    @once_differentiable
    def backward(ctx, d) -> tuple[torch.Tensor | None, ...]:
        weight, *saved = ctx.saved_tensors
        parts, activated = (saved[:-1], saved[-1:]) if ctx.has_relu else (saved, [])
        lead, d = d.shape[:-1], d.reshape(-1, len(weight))
        if ctx.has_relu:
            d = torch.ops.aten.threshold_backward(d, *activated, 0)
        d_parts: list[torch.Tensor | None] = [None] * len(parts)
        d_weight = torch.empty_like(weight)
        sizes = [part.shape[1] for part in parts]
        rows = zip(parts, weight.split(sizes, 1), d_weight.split(sizes, 1), strict=True)
        for i, (part, its_weight, its_gradient) in enumerate(rows):
            matmul(d.T, part, its_gradient)
            if ctx.needs_input_grad[3 + i]:
                d_parts[i] = matmul(d, its_weight).view(*lead, sizes[i])
        return d_weight, d.sum(0), None, *d_parts
