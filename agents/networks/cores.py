"""Recurrent cores by name: lstm, gru, mingru and none.

A core is a module `Core(width)` with two methods:

- `initial(B, device)` returns the hidden state of B lanes at the start of an episode, an arrdict of
  (B, ...) float32 tensors.
- `forward(x, reset, state)` unrolls over x (T, B, W) from a hidden state. It clears a lane's state
  before each step where reset (T, B) is true, and returns outputs (T, B, W) and the state after the
  last step. With `is_residual`, LSTM and minGRU add x to the outputs.

T time, B lanes, W width.
"""

from collections.abc import Iterator
from typing import Protocol, cast

import torch
from torch import nn

from megastep import spaces
from megastep.agents.networks.intakes import ACTIVATIONS
from megastep.agents.networks.linear import linear
from megastep.agents.networks.lstm import LSTM
from megastep.agents.networks.mingru import MinGRU
from megastep.arrdict import arrdict
from megastep.dotdict import leaves
from megastep.imports import resolve


class RecurrentCore(Protocol):
    """A recurrent core, as the head of this file says."""

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the hidden state of B lanes at the start of an episode."""
        ...

    def __call__(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict, **options: bool
    ) -> tuple[torch.Tensor, arrdict]: ...


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
        """Unrolls over a sequence, as the head of this file says."""
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
    activation is a name in `intakes.ACTIVATIONS`.
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


CORES = {"lstm": LSTM, "gru": GRU, "mingru": MinGRU, "none": Feedforward}


class Stack(nn.ModuleList):
    """Several cores with residual connections (He et al. 2016), which together are a core.

    The input of each is x plus the outputs of those below, and the output is the sum of all
    outputs. The hidden state holds theirs under "0", "1", ...
    """

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the hidden state of B lanes at the start of an episode."""
        return arrdict({str(i): c.initial(n_lanes, device) for i, c in enumerate(self._cores())})

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict, is_residual: bool = False
    ) -> tuple[torch.Tensor, arrdict]:
        """Unrolls over a sequence, as the head of this file says."""
        total, after = None, arrdict()
        # On a GPU each core's kernel adds its input. On a CPU sums keep their order and bits.
        if is_residual and x.is_cuda:
            for i, core in enumerate(self._cores()):
                x, after[str(i)] = with_residual(core, x, reset, state[str(i)])
            return x, after
        for i, core in enumerate(self._cores()):
            core_input = x if total is None else x + total
            outputs, after[str(i)] = core(core_input, reset, state[str(i)])
            total = outputs if total is None else total + outputs
        assert total is not None
        return x + total if is_residual else total, after

    def _cores(self) -> Iterator[RecurrentCore]:
        return cast("Iterator[RecurrentCore]", iter(self))


def with_residual(
    core: RecurrentCore, x: torch.Tensor, reset: torch.Tensor, state: arrdict
) -> tuple[torch.Tensor, arrdict]:
    """Returns x plus the outputs of a core, and its state after the last step."""
    if isinstance(core, (LSTM, MinGRU, Stack)):
        return core(x, reset, state, is_residual=True)
    outputs, state = core(x, reset, state)
    return x + outputs, state


def make_core(name: str, width: int, layers: int = 1, activation: str = "relu") -> RecurrentCore:
    """Returns a recurrent core, a name in `CORES` or an import path; several layers make a `Stack`.
    The activation is that of the core "none". ValueError if there is no such core, or it breaks the
    contract at the head of this file.
    """
    kind = resolve(name, CORES, nn.Module)
    options = {"activation": activation} if kind is Feedforward else {}
    cores = [kind(width, **options) for _ in range(layers)]
    if ":" in name:
        _check(name, cores[0], width)
    return cores[0] if layers == 1 else Stack(cores)


@torch.no_grad()
def _check(name, core, width, n_steps=3, n_lanes=2) -> None:
    """Runs a core on two inputs that differ only before a reset."""

    def require(condition, clause) -> None:
        if not condition:
            raise ValueError(f"{name} breaks the contract of recurrent cores: {clause}")

    require(hasattr(core, "initial"), "it needs a method initial(B, device)")
    state = core.initial(n_lanes, "cpu")
    require(isinstance(state, arrdict), "the hidden state must be an arrdict of tensors")
    has_lanes = all(len(leaf) == n_lanes for leaf in leaves(state))
    require(has_lanes, "the hidden state must have a row per lane")
    generator = torch.Generator().manual_seed(1)
    x, other = torch.randn(2, n_steps, n_lanes, width, generator=generator)
    other[1:] = x[1:]
    reset = torch.zeros(n_steps, n_lanes, dtype=torch.bool)
    reset[1] = True
    (outputs, after), (other_outputs, _) = core(x, reset, state), core(other, reset, state)
    shape, expected = tuple(outputs.shape), (n_steps, n_lanes, width)
    require(shape == expected, f"outputs must be (T, B, width), here {expected}, not {shape}")
    shapes = [{key: leaf.shape for key, leaf in spaces.leaves(s).items()} for s in (state, after)]
    require(shapes[0] == shapes[1], "the hidden state must keep its keys and shapes")
    is_cleared = torch.equal(outputs[1:], other_outputs[1:])
    require(is_cleared, "a reset must clear the hidden state")
