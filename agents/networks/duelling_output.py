"""The output of action values: a duelling network.

`...` any leading axes, such as (B,) lanes or (T, B) time and lanes; A agents that one lane
controls, n choices of each.
"""

import math

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep import spaces
from megastep.agents.networks import products
from megastep.agents.networks.kernels import duelling as kernels
from megastep.agents.networks.kernels.library import aligned
from megastep.agents.networks.layers import linear
from megastep.agents.networks.outputs import FORBIDDEN, Output, gather
from megastep.agents.networks.precision import cast, compute_dtype


class DuellingOutput(Output):
    """Action values (..., A, n) of a duelling network (Wang et al. 2016): the lane's value plus
    advantages minus their mean, each behind a hidden layer, in whatever scale a learner fits.

    Action values replace `logits`. `sample` is epsilon-greedy: a policy that is
    always greedy can stand before a wall forever. `action_value` (...,) belongs to the lane's joint
    action, the sum over its agents (VDN, Sunehag et al. 2018).

    Args:
        space: action space.
        width: number of features.
    """

    epsilon = 0.05

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

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self._is_fused(x):
            x = x.to(torch.bfloat16)
            return _DuellingValues.apply(x, *self.hidden.parameters(), *self._values(), self.shape)
        hidden = linear(x, self.hidden, torch.relu)
        # bfloat16 would round large values by more than actions differ
        with torch.autocast(x.device.type, enabled=False):
            value, advantage = hidden.float().chunk(2, -1)
            value = self.value(value)[..., None]
            advantage = self.advantage(advantage).unflatten(-1, self.shape)
        return value + advantage - advantage.mean(-1, keepdim=True)

    def act(
        self,
        x: torch.Tensor,
        sample: bool = True,
        generator: torch.Generator | None = None,
        mask: torch.Tensor | None = None,
        epsilon: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Does the same as `Output.act`, without a mask on a GPU in one kernel after the hidden
        layer's.
        """
        if torch.is_grad_enabled() or not self._is_fused(x) or mask is not None:
            options: dict = {} if epsilon is None else dict(epsilon=epsilon)
            if mask is not None:
                options["is_masked"] = True
            return super().act(x, sample, generator, mask, **options)
        hidden = linear(x, self.hidden, torch.relu)
        noise = self._noise((len(x), self.shape[0]), generator, x.device) if sample else None
        parameters = [aligned(p.detach()) for p in self._values()]
        if epsilon is not None:
            epsilon = epsilon.float().contiguous()
        return kernels.act(hidden, parameters, self.shape, noise, epsilon, self.epsilon)

    def masked(self, logits: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Returns values with which only allowed actions are the best."""
        return logits if mask is None else logits.masked_fill(~mask, FORBIDDEN)

    def _is_fused(self, x) -> bool:
        return (
            x.is_cuda
            and compute_dtype(self.hidden.weight) == torch.bfloat16
            and x.shape[-1] % 8 == 0
            and math.prod(self.shape) <= kernels.MAX_OUTPUTS
        )

    def _values(self) -> tuple[torch.Tensor, ...]:
        return *self.value.parameters(), *self.advantage.parameters()

    @staticmethod
    def _noise(shape, generator, device) -> torch.Tensor:
        """Returns (2, *shape) from 0 to 1: which random action, and whether to take it."""
        return torch.rand(2, *shape, generator=generator, device=device)

    def sample(
        self,
        logits: torch.Tensor,
        generator: torch.Generator | None = None,
        epsilon: torch.Tensor | None = None,
        is_masked: bool = False,
    ) -> torch.Tensor:
        """Returns the best actions, or random ones with probability epsilon (...,) per lane.

        Args:
            is_masked: some of the logits are those that `masked` forbids.
        """
        limit = self.epsilon if epsilon is None else epsilon[..., None]
        best, n = self.greedy(logits), logits.shape[-1]
        which, whether = self._noise(best.shape, generator, logits.device)
        if is_masked:
            rank = (logits > FORBIDDEN / 2).cumsum(-1)  # of each allowed action, from 1
            n = rank[..., -1].clamp(min=1)
            chosen = (which * n).long().clamp(max=n - 1) + 1
            random = (rank >= chosen[..., None]).int().argmax(-1)
        else:
            random = (which * n).long().clamp(max=n - 1)  # the product may round up to n
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
        return gather(logits, actions)


class _DuellingValues(torch.autograd.Function):
    """`DuellingOutput.forward`: one product and one kernel forward, two products and one kernel
    backward. The values and the weights' gradients are float32 sums.
    """

    @staticmethod
    def forward(ctx, x, hidden_weight, hidden_bias, *parameters_and_shape) -> torch.Tensor:
        *parameters, shape = parameters_and_shape
        lead, x = x.shape[:-1], x.flatten(0, -2)
        weight, bias = (cast(leaf, x.dtype) for leaf in (hidden_weight, hidden_bias))
        hidden = products.layer(x, weight, bias, has_relu=True)
        parameters = [aligned(p.detach()) for p in parameters]
        values = kernels.values(hidden, parameters, shape)
        value_weight, _, advantage_weight, _ = parameters
        ctx.save_for_backward(x, weight, hidden, value_weight, advantage_weight)
        return values.unflatten(0, lead)

    @staticmethod
    @once_differentiable
    def backward(ctx, d_values) -> tuple[torch.Tensor | None, ...]:
        x, weight, hidden, *weights = ctx.saved_tensors
        lead, d_values = d_values.shape[:-2], d_values.flatten(0, -3).contiguous()
        d_hidden, gradients = kernels.backward(hidden, *weights, d_values=d_values)
        d_x = None
        if ctx.needs_input_grad[0]:
            d_x = products.of_inputs(d_hidden, weight).unflatten(0, lead)
        return d_x, products.of_weights(d_hidden, x), *gradients, None
