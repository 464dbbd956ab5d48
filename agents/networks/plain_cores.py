"""The recurrent cores "gru" and "none", without kernels of their own. T time, B lanes, W width."""

import torch
from torch import nn

from megastep.agents.networks.linear import ACTIVATIONS, linear
from megastep.arrdict import arrdict


class GRU(nn.Module):
    """A gated recurrent unit (Cho et al. 2014) with PyTorch's equations: the reset gate comes after
    the matrix product. Its hidden state is arrdict(output (B, W)).

    Gates are laid out (..., 3 W): reset, update, candidate. Matrix products run in the compute
    dtype (autocast's), the rest in float32.
    """

    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.input, self.recurrent = nn.Linear(width, 3 * width), nn.Linear(width, 3 * width)
        for layer in (self.input, self.recurrent):
            nn.init.zeros_(layer.bias)
            for block in layer.weight.split(width):
                nn.init.orthogonal_(block)

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the hidden state of B lanes at the start of an episode."""
        return arrdict(output=torch.zeros(n_lanes, self.width, device=device))

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict
    ) -> tuple[torch.Tensor, arrdict]:
        """Unrolls over a sequence, as the head of cores.py says."""
        from_input, output, outputs = self.input(x), state["output"], []
        for t in range(len(x)):
            output = output.masked_fill(reset[t, :, None], 0.0)
            r_in, z_in, n_in = from_input[t].float().chunk(3, -1)
            r, z, n = self.recurrent(output).float().chunk(3, -1)
            candidate = (n_in + (r_in + r).sigmoid() * n).tanh()
            output = candidate.lerp(output, (z_in + z).sigmoid())
            outputs.append(output)
        return torch.stack(outputs).to(from_input.dtype), arrdict(output=output)


class Feedforward(nn.Module):
    """A hidden layer instead of a recurrent core: only the current observation counts. The
    activation is a name in `linear.ACTIVATIONS`.
    """

    def __init__(self, width: int, activation: str = "relu"):
        super().__init__()
        self.activation = ACTIVATIONS[activation]
        self.hidden = nn.Linear(width, width)
        nn.init.orthogonal_(self.hidden.weight, gain=2**0.5)
        nn.init.zeros_(self.hidden.bias)

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns an empty hidden state."""
        return arrdict()

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict
    ) -> tuple[torch.Tensor, arrdict]:
        """Applies the layer to every step. `reset` and `state` have no effect."""
        return linear(x, self.hidden, self.activation), state
