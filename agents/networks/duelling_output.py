"""The output of action values: a duelling network. Axes are those of `heads`."""

import math

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep import spaces
from megastep.agents.generator import draw
from megastep.agents.networks.fused import LIBRARY, aligned, fused
from megastep.agents.networks.heads import FORBIDDEN, Output
from megastep.agents.networks.linear import (
    cast,
    compute_dtype,
    gradient_of_inputs,
    gradient_of_weights,
    linear,
    product,
    sum_rows,
)
from megastep.kernels.build.launch import BLOCK, WARP, Blocks, launch

_MAX_OUTPUTS, _STRIP, _THREADS = (
    LIBRARY.constants[f"DUELLING_{name}"] for name in ("OUTPUTS", "STRIP", "THREADS")
)
_BLOCK_ROWS = BLOCK // WARP * (WARP // _MAX_OUTPUTS)


def _fits(output, x) -> bool:
    is_bf16 = x.is_cuda and compute_dtype(output.hidden.weight) == torch.bfloat16
    return is_bf16 and x.shape[-1] % 8 == 0 and math.prod(output.shape) <= _MAX_OUTPUTS


def _launch_values(operation, hidden, parameters, shape, **fields) -> torch.Tensor:
    """Computes action values (N, A, n) float32 from the hidden layer (N, 2 W) after its ReLU."""
    n_rows, n_features = hidden.shape
    values = torch.empty(n_rows, *shape, device=hidden.device)
    names = "value_weight", "value_bias", "advantage_weight", "advantage_bias"
    parameters = (aligned(p.detach()) for p in parameters)
    unused = dict.fromkeys(("noise", "epsilon", "actions", "logprobs"))
    launch(
        *(LIBRARY, operation, hidden.device, Blocks(-(-n_rows // _BLOCK_ROWS))),
        **dict(zip(names, parameters, strict=True), hidden=hidden, values=values),
        **{**unused, "usual_epsilon": 1.0, **fields},
        **dict(n_rows=n_rows, width=n_features // 2, n_agents=shape[0], n_choices=shape[1]),
    )
    return values


def _act_on_gpu(
    output, x, sample=True, generator=None, mask=None, epsilon=None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    hidden, (n_lanes, device) = linear(x, output.hidden, torch.relu), (len(x), x.device)
    noise = output.noise((n_lanes, output.shape[0]), generator, device) if sample else None
    actions = torch.empty(n_lanes, output.shape[0], dtype=torch.int64, device=device)
    logprobs = torch.empty(n_lanes, device=device)
    epsilon = None if epsilon is None else epsilon.float().contiguous()
    results = dict(noise=noise, epsilon=epsilon, actions=actions, logprobs=logprobs)
    where = "duelling_act", hidden, output.value_parameters(), output.shape
    values = _launch_values(*where, usual_epsilon=output.epsilon, **results)
    return values, actions, logprobs


def _acts_on_gpu(output, x, sample=True, generator=None, mask=None, epsilon=None) -> bool:
    return mask is None and not torch.is_grad_enabled() and _fits(output, x)


def _values_on_gpu(output, x) -> torch.Tensor:
    parameters = *output.hidden.parameters(), *output.value_parameters()
    return _Values.apply(x.to(torch.bfloat16), *parameters, output.shape)


class _Values(torch.autograd.Function):
    """The values and the weights' gradients are float32 sums."""

    @staticmethod
    def forward(ctx, x, hidden_weight, hidden_bias, *parameters_and_shape) -> torch.Tensor:
        *parameters, shape = parameters_and_shape
        lead, x = x.shape[:-1], x.flatten(0, -2)
        weight, bias = (cast(leaf, x.dtype) for leaf in (hidden_weight, hidden_bias))
        hidden = product(x, weight, bias, has_relu=True)
        values = _launch_values("duelling_values", hidden, parameters, shape)
        value_weight, _, advantage_weight, _ = parameters
        ctx.save_for_backward(x, weight, hidden, aligned(value_weight), aligned(advantage_weight))
        return values.unflatten(0, lead)

    @staticmethod
    @once_differentiable
    def backward(ctx, d_values) -> tuple[torch.Tensor | None, ...]:
        x, weight, hidden, value_weight, advantage_weight = ctx.saved_tensors
        lead, d_values = d_values.shape[:-2], d_values.flatten(0, -3).contiguous()
        n_rows, n_agents, n_choices = d_values.shape
        width, n_outputs = value_weight.shape[1], n_agents * n_choices
        sizes = [2 * width, n_agents * width, n_outputs * width, n_agents, n_outputs]
        n_strips, n_parts = -(-n_rows // _STRIP), -(-width // _THREADS)
        d_hidden, sums = torch.empty_like(hidden), d_values.new_empty(n_strips, sum(sizes))
        launch(
            *(LIBRARY, "duelling_backward", hidden.device, Blocks(n_strips, n_parts, _THREADS)),
            **dict(hidden=hidden, value_weight=value_weight, advantage_weight=advantage_weight),
            **dict(d_values=d_values, d_hidden=d_hidden, sums=sums, n_sums=sum(sizes)),
            **dict(n_rows=n_rows, width=width, n_agents=n_agents, n_choices=n_choices),
        )
        d_bias, d_value, d_advantage, d_value_bias, d_advantage_bias = sum_rows(sums).split(sizes)
        d_x = None
        if ctx.needs_input_grad[0]:
            d_x = gradient_of_inputs(d_hidden, weight).unflatten(0, lead)
        return (
            *(d_x, gradient_of_weights(d_hidden, x), d_bias),
            *(d_value.view_as(value_weight), d_value_bias),
            *(d_advantage.view_as(advantage_weight), d_advantage_bias, None),
        )


class DuellingOutput(Output):
    """Action values (..., A, n) of a duelling network (Wang et al. 2016): the lane's value plus
    advantages minus their mean, each behind a hidden layer, in whatever scale a learner fits.

    Action values replace `logits`. `sample` is epsilon-greedy: a policy that is
    always greedy can stand before a wall forever. `action_value` (...,) belongs to the lane's joint
    action, the sum over its agents (VDN, Sunehag et al. 2018).
    """

    epsilon = 0.05
    act = fused(_act_on_gpu, _acts_on_gpu)(Output.act)

    def __init__(self, space: spaces.MultiDiscrete, width: int):
        super().__init__()
        self.shape = (space.n_agents, space.n_actions)
        self.hidden = nn.Linear(width, 2 * width)
        self.value = nn.Linear(width, space.n_agents)
        self.advantage = nn.Linear(width, math.prod(self.shape))
        # The bias keeps its random initialisation: with zeros, features of 0 would put every ReLU
        # exactly at its kink.
        nn.init.orthogonal_(self.hidden.weight, gain=2**0.5)
        for layer in self.value, self.advantage:
            nn.init.orthogonal_(layer.weight, gain=0.1)
            nn.init.zeros_(layer.bias)

    @fused(_values_on_gpu, _fits)
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        hidden = linear(x, self.hidden, torch.relu)
        # bfloat16 would round large values by more than actions differ
        with torch.autocast(x.device.type, enabled=False):
            value, advantage = hidden.float().chunk(2, -1)
            value = self.value(value)[..., None]
            advantage = self.advantage(advantage).unflatten(-1, self.shape)
        return value + advantage - advantage.mean(-1, keepdim=True)

    def masked(self, logits: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Returns values with which only allowed actions are the best."""
        return logits.masked_fill(~mask, FORBIDDEN)

    def value_parameters(self) -> tuple[torch.Tensor, ...]:
        """Returns weight and bias of the value, then of the advantages."""
        return *self.value.parameters(), *self.advantage.parameters()

    def noise(self, shape, generator, device) -> torch.Tensor:
        """Returns (2, *shape) from 0 to 1: which random action, and whether to take it."""
        return draw(self, torch.Tensor.uniform_, (2, *shape), generator, device)

    def sample(
        self,
        logits: torch.Tensor,
        generator: torch.Generator | None = None,
        epsilon: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Returns the best actions, or random ones with probability epsilon (...,) per lane, none
        of those that `masked` forbids.
        """
        limit = self.epsilon if epsilon is None else epsilon[..., None]
        best = self.greedy(logits)
        which, whether = self.noise(best.shape, generator, logits.device)
        rank = (logits > FORBIDDEN / 2).cumsum(-1)  # of each allowed action, from 1
        n = rank[..., -1].clamp(min=1)
        chosen = (which * n).long().clamp(max=n - 1) + 1  # the product may round up to n
        random = (rank >= chosen[..., None]).int().argmax(-1)
        return torch.where(whether < limit, random, best)

    def greedy(self, logits: torch.Tensor) -> torch.Tensor:
        """Returns the best actions."""
        return logits.argmax(-1)

    def logprob(self, logits: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Returns the log-probability (...,) of actions under `sample` with the default epsilon."""
        n, is_best = logits.shape[-1], actions == self.greedy(logits)
        return ((1 - self.epsilon) * is_best + self.epsilon / n).log().sum(-1)

    def action_value(self, logits: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Returns the value (...,) of actions."""
        return logits.gather(-1, actions.long()[..., None]).squeeze(-1).sum(-1)
