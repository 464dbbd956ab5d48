"""Linear layers, the dtype that they compute in, the matrix products of layers and of their
gradients, and linear recurrences.

In bfloat16 on a GPU, a layer's bias and ReLU are part of the product, one kernel masks the gradient
and adds up its rows, and weights' gradients are float32 sums that are never rounded. On a CPU a
kernel divides large float32 products among the engine's threads.

N rows, K inputs, M outputs; `...` any leading axes, such as (T, B) time and lanes.
"""

import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep.agents.networks import few_rows
from megastep.agents.networks.fused import (
    LIBRARY,
    aligned_rows,
    fused,
    is_built_for_cpu,
    is_plain_on_gpu,
)
from megastep.devices import threads
from megastep.kernels.build.launch import WARP, Blocks, launch

if TYPE_CHECKING:
    from typing_extensions import Self

Activation = Callable[[torch.Tensor], torch.Tensor]
#: Activations of hidden layers by name.
ACTIVATIONS: dict[str, Activation] = {"relu": torch.relu, "tanh": torch.tanh}

_MIN_OUTPUTS = 16  # PyTorch takes less time on a CPU for fewer, such as actions and values
_STRIP, _STRIP_THREADS = LIBRARY.constants["STRIP"], LIBRARY.constants["STRIP_THREADS"]

# ---- The dtype, and casts of weights to it ----

_THREAD = threading.local()  # its `context` is the innermost `ComputeDtype`, if there is one
_MULTIPLE = 8  # rows that tensor cores want; the only padding of weights that are cast together
_MAX_ROWS, _THREADS = LIBRARY.constants["CAST_ROWS"], LIBRARY.constants["CAST_THREADS"]


class ComputeDtype(torch.autocast):
    """Autocast that casts each weight only once until the outermost context ends. Weights must not
    change inside it. Those that `weights` returns are cast together on a GPU.
    """

    #: Weights and what `cast` returned of them, with the weights so that no other gets their id.
    casts: dict[tuple, tuple[object, torch.Tensor]]

    def __init__(
        self,
        device_type: str,
        dtype: torch.dtype,
        weights: Callable[[], Iterable[torch.Tensor]] = tuple,
    ):
        super().__init__(device_type, dtype)
        self.weights = weights

    def __enter__(self) -> "Self":
        self.outer: ComputeDtype | None = getattr(_THREAD, "context", None)
        self.casts = self.outer.casts if self.outer else {}
        _THREAD.context = self
        super().__enter__()
        return self

    def __exit__(self, *args: object) -> None:
        _THREAD.context = self.outer
        super().__exit__(*args)


def cast(weight: torch.Tensor, dtype: torch.dtype, multiple: int = 1) -> torch.Tensor:
    """Returns a weight (N, ...) in another dtype, without autograd. Rows of zeros are added until
    there are a multiple of `multiple`.
    """
    n_padding = -len(weight) % multiple
    if weight.dtype == dtype and not n_padding:
        return weight
    context, key = getattr(_THREAD, "context", None), (id(weight), dtype, multiple)
    casts = context.casts if context else {}
    if context and key not in casts and dtype == torch.bfloat16:
        _cast_together(weight, context)
    if key in casts:
        return casts[key][1]
    result = weight.detach().to(dtype)
    if n_padding:
        result = torch.cat([result, result.new_zeros(n_padding, *weight.shape[1:])])
    casts[key] = weight, result
    return result


def cast_joined(weights: tuple[torch.Tensor, ...], dtype: torch.dtype) -> torch.Tensor:
    """Returns weights (N, n) each, cast as by `cast` and joined along columns: (N, sum of n)."""
    context, key = getattr(_THREAD, "context", None), (*map(id, weights), dtype)
    casts = context.casts if context else {}
    if key not in casts:
        casts[key] = weights, torch.cat([cast(weight, dtype).detach() for weight in weights], 1)
    return casts[key][1]


@torch.no_grad()
def _cast_together(weight, context) -> None:
    """Rounds all weights of the context to bfloat16 in one kernel, if this is one of them."""
    weights = [w for w in context.weights() if w.dim() and is_plain_on_gpu(w)]
    if not any(w is weight for w in weights):
        return
    for w, padded in zip(weights, rounded(weights), strict=True):
        context.casts[id(w), torch.bfloat16, 1] = w, padded[: len(w)]
        context.casts[id(w), torch.bfloat16, _MULTIPLE] = w, padded


def rounded(weights: list[torch.Tensor]) -> list[torch.Tensor]:
    """Returns weights (N, ...) float32, contiguous on a GPU, in bfloat16, with rows of zeros up to
    a multiple of 8.
    """
    shapes = [(len(weight) + -len(weight) % _MULTIPLE, *weight.shape[1:]) for weight in weights]
    sizes = [torch.Size(shape).numel() for shape in shapes]
    memory = torch.empty(sum(sizes), dtype=torch.bfloat16, device=weights[0].device)
    targets = memory.split(sizes)
    for start in range(0, len(weights), _MAX_ROWS):
        some, rows, n_blocks = slice(start, start + _MAX_ROWS), [], 0
        for weight, target in zip(weights[some], targets[some], strict=True):
            numbers = dict(n=weight.numel(), n_padded=target.numel(), first_block=n_blocks)
            rows.append(LIBRARY.params.CastRowParams(source=weight, target=target, **numbers))
            n_blocks += max(1, -(-target.numel() // (8 * _THREADS)))
        blocks = Blocks(n_blocks, threads=_THREADS)
        launch(LIBRARY, "cast", memory.device, blocks, rows=b"".join(rows), n_rows=len(rows))
    return [target.view(shape) for target, shape in zip(targets, shapes, strict=True)]


def compute_dtype(weight: torch.Tensor) -> torch.dtype:
    """Returns the dtype of a matrix product with `weight`: autocast's if it is on, else the
    weight's own.
    """
    device = weight.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else weight.dtype


# ---- Layers ----


def _fits(x, layer, activation=None) -> bool:
    weight, parts = layer.weight, x if isinstance(x, tuple) else (x,)
    dtype = compute_dtype(weight)
    if activation not in (None, torch.relu):
        return False
    if parts[0].is_cuda:
        return dtype == torch.bfloat16 and not any(part.shape[-1] % 8 for part in parts)
    are_floats = weight.device.type == "cpu" and dtype == weight.dtype == torch.float32
    return are_floats and len(weight) >= _MIN_OUTPUTS and is_built_for_cpu()


def _by_kernel(x, layer, activation=None) -> torch.Tensor:
    parts, dtype = x if isinstance(x, tuple) else (x,), compute_dtype(layer.weight)
    parts = [part.to(dtype) for part in parts]
    return _Layer.apply(layer.weight, layer.bias, activation, *parts)


@fused(_by_kernel, _fits, on_cpu=True)
def linear(
    x: torch.Tensor | tuple[torch.Tensor, torch.Tensor],
    layer: nn.Linear,
    activation: Activation | None = None,
) -> torch.Tensor:
    """Applies a linear layer and an activation, such as `torch.relu`, in the compute dtype:
    (..., K) -> (..., M). The input may be two parts, as if concatenated.
    """
    x = torch.cat(x, -1) if isinstance(x, tuple) else x
    y = nn.functional.linear(x.to(compute_dtype(layer.weight)), layer.weight, layer.bias)
    return y if activation is None else activation(y)


class _Layer(torch.autograd.Function):
    """On a GPU, odd numbers of outputs are padded to a multiple of 8, as tensor cores want."""

    @staticmethod
    def forward(ctx, weight, bias, activation, *parts) -> torch.Tensor:
        ctx.n_outputs, has_relu = len(weight), activation is not None
        dtype, on_gpu, lead = parts[0].dtype, parts[0].is_cuda, parts[0].shape[:-1]
        weight, bias = (cast(leaf, dtype, multiple=8 if on_gpu else 1) for leaf in (weight, bias))
        parts = [part.reshape(-1, part.shape[-1]) for part in parts]
        weights = weight.split([part.shape[1] for part in parts], 1)
        y, last = None, len(parts) - 1
        for i, (part, its_weight) in enumerate(zip(parts, weights, strict=True)):
            its_bias, with_relu = bias if i == 0 else None, has_relu and i == last
            if on_gpu:
                y = product(part, its_weight, its_bias, with_relu, y)
            else:
                y = matmul(part, its_weight.T, y, its_bias, i > 0, with_relu)
        assert y is not None
        ctx.has_relu, ctx.on_gpu = has_relu, on_gpu
        ctx.save_for_backward(weight, *parts, *[y] * has_relu)
        return y[:, : ctx.n_outputs].view(*lead, ctx.n_outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, d) -> tuple[torch.Tensor | None, ...]:
        weight, *saved = ctx.saved_tensors
        parts, activated = (saved[:-1], saved[-1]) if ctx.has_relu else (saved, None)
        lead, n_padding = d.shape[:-1], len(weight) - ctx.n_outputs
        d = d.reshape(-1, ctx.n_outputs)
        d = nn.functional.pad(d, (0, n_padding)) if n_padding else d
        d, d_bias = bias_gradient(d, activated)
        of_weights, of_inputs = gradient_of_weights, gradient_of_inputs
        if not ctx.on_gpu:
            of_weights, of_inputs = (lambda d, x: matmul(d.T, x)), matmul
        d_weight = None
        if ctx.needs_input_grad[0]:
            d_weights = [of_weights(d, part) for part in parts]
            d_weight = torch.cat(d_weights, 1) if len(parts) > 1 else d_weights[0]
            d_weight = d_weight[: ctx.n_outputs]
        d_parts: list[torch.Tensor | None] = [None] * len(parts)
        for i, its_weight in enumerate(weight.split([part.shape[1] for part in parts], 1)):
            if ctx.needs_input_grad[3 + i]:
                d_parts[i] = of_inputs(d, its_weight).view(*lead, its_weight.shape[1])
        return d_weight, d_bias[: ctx.n_outputs], None, *d_parts


# ---- The sums of a gradient ----


def _bias_gradient_on_gpu(d, activated=None) -> tuple[torch.Tensor, torch.Tensor]:
    d = aligned_rows(d)
    n_rows, n_columns = d.shape
    n_strips, n_words = -(-n_rows // _STRIP), n_columns // 8
    d_masked = None if activated is None else torch.empty_like(activated)
    sums = d.new_empty(n_strips, n_columns, dtype=torch.float32)
    blocks = Blocks(n_strips, -(-n_words // WARP), _STRIP_THREADS)
    launch(
        *(LIBRARY, "bias_gradient", d.device, blocks),
        **dict(d=d, activated=activated, d_masked=d_masked, sums=sums),
        **dict(n_rows=n_rows, n_columns=n_columns, d_stride=d.stride(0)),
    )
    return d if d_masked is None else d_masked, sum_rows(sums)


@fused(_bias_gradient_on_gpu, lambda d, *_: d.is_cuda and d.dtype == torch.bfloat16)
def bias_gradient(
    d: torch.Tensor, activated: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the gradient before a ReLU (N, M), and its sum over rows (M,) float32, from that
    after it and the ReLU's outputs. None: there is no ReLU.
    """
    if activated is not None:
        d = torch.ops.aten.threshold_backward(d, activated, 0)
    return d, d.sum(0)


def sum_rows(rows: torch.Tensor) -> torch.Tensor:
    """Returns the sums (M,) of rows (N, M) float32 on a GPU, always in the same order."""
    sums = rows.new_empty(rows.shape[1])
    blocks = Blocks(-(-rows.shape[1] // WARP), threads=_STRIP_THREADS)
    sizes = dict(n_rows=rows.shape[0], n_columns=rows.shape[1])
    launch(LIBRARY, "sum_rows", rows.device, blocks, rows=rows, sums=sums, **sizes)
    return sums


# ---- Matrix products ----
#
# On a GPU those of few rows are by kernels of our own. Gradients of weights are always by PyTorch,
# which splits the rows that they add up. All matrices have one dtype.


def product(
    x: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor | None,
    has_relu: bool = False,
    onto: torch.Tensor | None = None,
) -> torch.Tensor:
    """Returns the outputs (..., M) of a linear layer, with a ReLU if `has_relu`, of x (..., K), a
    weight (M, K) and a bias (M,). Without a bias, the product of x (N, K) is added to `onto` (N, M)
    in place.
    """
    rows = x.flatten(0, -2)
    if bias is None:
        assert onto is not None
        if few_rows.fits(rows, weight, onto):
            few_rows.multiply(rows, weight, addend=onto, out=onto)
        else:
            onto.addmm_(rows, weight.T)
        return onto.relu_() if has_relu else onto
    if few_rows.fits(rows, weight) and not len(weight) % 8 and bias.is_contiguous():
        outputs = few_rows.multiply(rows, weight, bias, has_relu=has_relu)
    elif has_relu:
        outputs = torch._addmm_activation(bias, rows, weight.T)  # pyright: ignore[reportPrivateImportUsage]
    else:
        outputs = torch.addmm(bias, rows, weight.T)
    return outputs.unflatten(0, x.shape[:-1])


def gradient_of_inputs(
    d: torch.Tensor, weight: torch.Tensor, addend: torch.Tensor | None = None
) -> torch.Tensor:
    """Returns the gradient (..., K) of a layer's inputs from that of its outputs (..., M) and its
    weight (M, K), plus a contiguous addend (..., K), in whose place it is.
    """
    rows = d.flatten(0, -2)
    flat = None if addend is None else addend.flatten(0, -2)
    addends = () if flat is None else (flat,)
    if few_rows.fits(rows, weight, *addends) and all(x.is_contiguous() for x in addends):
        result = few_rows.multiply(rows, weight, addend=flat, out=flat, of_inputs=True)
    else:
        result = rows @ weight if flat is None else flat.addmm_(rows, weight)
    return result.unflatten(0, d.shape[:-1])


def gradient_of_weights(d: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Returns the gradient (M, K) float32 of a layer's weights from that of its outputs (N, M) and
    its inputs (N, K). A GPU does not round it to the matrices' dtype.
    """
    if d.is_cuda and d.dtype != torch.float32:
        return torch.mm(d.T, x, out_dtype=torch.float32)
    return (d.T @ x).float()


def matmul(
    a: torch.Tensor,
    b: torch.Tensor,
    out: torch.Tensor | None = None,
    bias: torch.Tensor | None = None,
    adds: bool = False,
    has_relu: bool = False,
) -> torch.Tensor:
    """Returns the product of (rows, depth) and (depth, columns) float32 on the CPU, of any strides,
    plus a bias (columns,), with a ReLU if `has_relu`. Without a gradient. If given, `out` has it,
    in contiguous rows, added to what is there if `adds`.
    """
    out = torch.empty(len(a), b.shape[1]) if out is None else out
    launch(
        *(LIBRARY, "matmul", a.device, 0),
        **dict(a=a, b=b, bias=None if bias is None else bias.contiguous(), out=out),
        **dict(a_row=a.stride(0), a_column=a.stride(1), b_row=b.stride(0), b_column=b.stride(1)),
        **dict(out_row=out.stride(0), n_rows=len(a), n_columns=b.shape[1], depth=len(b)),
        **dict(adds=adds, has_relu=has_relu, n_threads=threads()),
    )
    return out


# ---- Linear recurrences ----


def linear_scan(
    terms: torch.Tensor,
    factors: torch.Tensor,
    reset: torch.Tensor | None = None,
    reverse: bool = False,
) -> torch.Tensor:
    """Computes y_t = terms_t + factors_t y_{t-1}, y_{-1} = 0, along the first axis.

    Uses parallel doubling (Hillis and Steele 1986): after a pass of stride k, `total` holds the
    last 2k terms of each sum, `product` the factor of what comes before them, and `reset` whether
    that is cut off. Nothing is divided, so factors of 0 are exact.

    Args:
        terms, factors: (T, ...).
        reset: bool, broadcasts to them. Where true, y_t = terms_t: not even a NaN passes.
        reverse: runs from the end instead, y_t = terms_t + factors_t y_{t+1}, y_T = 0.
    """
    if reverse:
        reset = None if reset is None else reset.flip(0)
        return linear_scan(terms.flip(0), factors.flip(0), reset).flip(0)
    total, product, stride = terms, factors, 1
    while stride < len(terms):
        first, here, before = slice(stride), slice(stride, None), slice(-stride)
        sums = torch.addcmul(total[here], product[here], total[before])
        if reset is not None:
            sums = torch.where(reset[here], total[here], sums)
            reset = torch.cat([reset[first], reset[here] | reset[before]])
        total = torch.cat([total[first], sums])
        product = torch.cat([product[first], product[here] * product[before]])
        stride *= 2
    return total
