"""The output of a duelling network on a GPU: action values, gradients, epsilon-greedy actions.

All tensors are contiguous and on one GPU, weights and features begin at a multiple of 16 bytes.
B lanes, A agents per lane, n choices, W features, a multiple of 8. A n is at most `MAX_OUTPUTS`.
"""

from collections.abc import Sequence

import torch

from megastep.agents.networks.kernels.layers import sum_rows
from megastep.agents.networks.kernels.library import LIBRARY
from megastep.kernels.build.launch import BLOCK, WARP, Blocks, launch

MAX_OUTPUTS = LIBRARY.constants["DUELLING_OUTPUTS"]
_STRIP, _THREADS = LIBRARY.constants["DUELLING_STRIP"], LIBRARY.constants["DUELLING_THREADS"]
_BLOCK_ROWS = BLOCK // WARP * (WARP // MAX_OUTPUTS)


def values(
    hidden: torch.Tensor, parameters: Sequence[torch.Tensor], shape: tuple[int, int]
) -> torch.Tensor:
    """Returns action values (rows, A, n) float32.

    Args:
        hidden: (rows, 2 W) bfloat16, the features of the value, then those of the advantages.
        parameters: weight (A, W) and bias (A,) of the value, weight (A n, W) and bias (A n,) of the
            advantages, float32.
        shape: (A, n).
    """
    return _forward("values", hidden, parameters, shape)


def act(
    hidden: torch.Tensor,
    parameters: Sequence[torch.Tensor],
    shape: tuple[int, int],
    noise: torch.Tensor | None,
    epsilon: torch.Tensor | None,
    usual_epsilon: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Computes action values and takes the best actions, or random ones.

    Args:
        hidden: (B, 2 W), as for `values`.
        parameters: as for `values`.
        shape: (A, n).
        noise: (2, B, A) uniform from 0 to 1: which random action, and whether to take it where it
            is below epsilon. None: takes the best actions.
        epsilon: (B,) float32. None: `usual_epsilon`.
        usual_epsilon: of the log-probabilities.

    Returns:
        action values (B, A, n), actions (B, A) int64, and their log-probability (B,).
    """
    n_lanes, device = len(hidden), hidden.device
    actions = torch.empty(n_lanes, shape[0], dtype=torch.int64, device=device)
    logprobs = torch.empty(n_lanes, device=device)
    tensors = dict(noise=noise, epsilon=epsilon, actions=actions, logprobs=logprobs)
    values = _forward("act", hidden, parameters, shape, usual_epsilon, **tensors)
    return values, actions, logprobs


def _forward(operation, hidden, parameters, shape, usual_epsilon=1.0, **tensors) -> torch.Tensor:
    n_rows, n_features = hidden.shape
    values = torch.empty(n_rows, *shape, device=hidden.device)
    names = "value_weight", "value_bias", "advantage_weight", "advantage_bias"
    optional = dict.fromkeys(("noise", "epsilon", "actions", "logprobs"))
    blocks = Blocks(-(-n_rows // _BLOCK_ROWS))
    launch(
        *(LIBRARY, f"duelling_{operation}", hidden.device, blocks),
        **dict(zip(names, parameters, strict=True), hidden=hidden, values=values),
        **(optional | tensors),
        n_rows=n_rows,
        width=n_features // 2,
        n_agents=shape[0],
        n_choices=shape[1],
        usual_epsilon=usual_epsilon,
    )
    return values


def backward(
    hidden: torch.Tensor,
    value_weight: torch.Tensor,
    advantage_weight: torch.Tensor,
    d_values: torch.Tensor,
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Computes the gradients of `values`, and of the hidden layer before its ReLU.

    Args:
        hidden: (rows, 2 W), after the ReLU.
        value_weight: (A, W).
        advantage_weight: (A n, W).
        d_values: (rows, A, n) float32.

    Returns:
        The gradient (rows, 2 W) before the ReLU, bfloat16. Its sum over the rows (2 W,), and the
        gradients of weight and bias of the value and of the advantages, float32.
    """
    n_rows, n_agents, n_choices = d_values.shape
    width, n_outputs = value_weight.shape[1], n_agents * n_choices
    sizes = [2 * width, n_agents * width, n_outputs * width, n_agents, n_outputs]
    n_strips, n_parts = -(-n_rows // _STRIP), -(-width // _THREADS)
    d_hidden = torch.empty_like(hidden)
    sums = d_values.new_empty(n_strips, sum(sizes))
    launch(
        *(LIBRARY, "duelling_backward", hidden.device, Blocks(n_strips, n_parts, _THREADS)),
        hidden=hidden,
        value_weight=value_weight,
        advantage_weight=advantage_weight,
        d_values=d_values,
        d_hidden=d_hidden,
        sums=sums,
        n_rows=n_rows,
        width=width,
        n_agents=n_agents,
        n_choices=n_choices,
        n_sums=sum(sizes),
    )
    d_bias, d_value, d_advantage, d_value_bias, d_advantage_bias = sum_rows(sums).split(sizes)
    d_weights = d_value.view_as(value_weight), d_advantage.view_as(advantage_weight)
    return d_hidden, [d_bias, d_weights[0], d_value_bias, d_weights[1], d_advantage_bias]
