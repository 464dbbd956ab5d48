"""The heads of an update on a GPU: everything after the product of the features with their weights.

N rows, W units of the critic's hidden layer, A agents per lane, n choices, F predicted features.
All tensors are contiguous, start at a multiple of 16 bytes and are on one GPU. A row of `product`
has the prediction, the actions' scores, and the critic's hidden layer before its ReLU, each padded
to a multiple of 8: (N, F' + (A n)' + W).
"""

from typing import NamedTuple

import torch

from megastep.agents.networks.kernels.layers import sum_rows
from megastep.agents.networks.kernels.library import LIBRARY
from megastep.kernels.build.launch import WARP, Blocks, launch

MULTIPLE = 8  # of which W is one
MAX_ROWS = 2**31 - LIBRARY.constants["STRIP"]
_STRIP, _STRIP_THREADS = LIBRARY.constants["STRIP"], LIBRARY.constants["STRIP_THREADS"]


class Sizes(NamedTuple):
    """The columns of `product`."""

    n_predicted: int  # F
    n_agents: int
    n_choices: int
    width: int  # W, a multiple of 8

    @property
    def starts(self) -> tuple[int, int, int]:
        """The first column of the scores and of the hidden layer, and the number of columns."""
        first_score = _padded(self.n_predicted)
        first_hidden = first_score + _padded(self.n_agents * self.n_choices)
        return first_score, first_hidden, first_hidden + self.width


class Value(NamedTuple):
    """A critic's output layer: weight (1, W), bias (1,), scale () and mean (), float32."""

    weight: torch.Tensor
    bias: torch.Tensor
    scale: torch.Tensor
    mean: torch.Tensor


def forward(
    product: torch.Tensor, target: torch.Tensor, actions: torch.Tensor, value: Value, sizes: Sizes
) -> tuple[torch.Tensor, ...]:
    """Returns the actions' log-probability, the entropy, the prediction's error and the value, (N,)
    float32 each.

    Args:
        product: (N, columns) bfloat16.
        target: (N, F') bfloat16, of the prediction.
        actions: (N, A) int64.
        value: the critic's output layer.
        sizes: of the columns.
    """
    results = product.new_empty(4, len(product), dtype=torch.float32).unbind()
    names = "logprobs", "entropies", "errors", "values"
    columns = dict(product=product, target=target, actions=actions)
    _forward(columns, dict(zip(names, results)), value, sizes)
    return results


def values(hidden: torch.Tensor, value: Value) -> torch.Tensor:
    """Returns the values (N,) float32 of a hidden layer (N, W) bfloat16 before its ReLU."""
    results = hidden.new_empty(len(hidden), dtype=torch.float32)
    columns = dict(product=hidden, target=None, actions=None)
    outputs = dict(logprobs=None, entropies=None, errors=None, values=results)
    _forward(columns, outputs, value, Sizes(0, 0, 0, hidden.shape[1]))
    return results


def _forward(columns, outputs, value, sizes) -> None:
    product = columns["product"]
    blocks = Blocks(_n_strips(product), threads=_STRIP_THREADS)
    launch(
        *(LIBRARY, "heads_forward", product.device, blocks),
        **columns,
        **{f"value_{name}": leaf for name, leaf in value._asdict().items()},
        **outputs,
        n_rows=len(product),
        **sizes._asdict(),
    )


def backward(
    product: torch.Tensor,
    target: torch.Tensor,
    actions: torch.Tensor,
    value: Value,
    sizes: Sizes,
    gradients: tuple[torch.Tensor, ...],
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns the gradient of `product`, its sum over rows (columns,) float32, and the gradients of
    the value's weight (1, W) and bias (1,).

    Args:
        product: of `forward`, as `target`, `actions`, `value` and `sizes`.
        gradients: of `forward`'s results, (N,) float32 each.
    """
    n_strips, n_columns = _n_strips(product), product.shape[1]
    n_parts = 1 + -(-sizes.width // (MULTIPLE * WARP))
    d_product = torch.empty_like(product)
    sums = product.new_empty(n_strips, n_columns + sizes.width + MULTIPLE, dtype=torch.float32)
    names = "d_logprobs", "d_entropies", "d_errors", "d_values"
    blocks = Blocks(n_strips * n_parts, threads=_STRIP_THREADS)
    launch(
        *(LIBRARY, "heads_backward", product.device, blocks),
        product=product,
        target=target,
        actions=actions,
        value_weight=value.weight,
        value_scale=value.scale,
        **dict(zip(names, gradients, strict=True)),
        d_product=d_product,
        sums=sums,
        n_rows=len(product),
        **sizes._asdict(),
    )
    d_bias, d_weight, d_value_bias = sum_rows(sums).split([n_columns, sizes.width, MULTIPLE])
    return d_product, d_bias, d_weight[None], d_value_bias[:1]


def _padded(n) -> int:
    return n + -n % MULTIPLE


def _n_strips(product) -> int:
    return -(-len(product) // _STRIP)
