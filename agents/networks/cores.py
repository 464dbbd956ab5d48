"""What lasts from step to step: the recurrent cores of policies, by name.

A core is a module `Core(width)`. `initial(B, device)` gives the state of B lanes at the start of an
episode, an arrdict of (B, ...) float32. `core(x, reset, state)` runs over x (T, B, W) from a state,
which it clears before each step where reset (T, B), and returns outputs (T, B, W) and the state
after the last step. Axes: T time, B lanes, W width.
"""

import torch
from torch import nn

from megastep.agents.imports import resolve
from megastep.agents.networks.lstm import LSTM
from megastep.agents.networks.mingru import MinGRU
from megastep.arrdict import arrdict
from megastep.dotdict import leaves


class GRU(nn.Module):
    """A gated recurrent unit (Cho et al. 2014), with the reset gate after the matrix product, as
    PyTorch's own has it. Its state is arrdict(output (B, W)).

    Gates are laid out (..., 3 W): reset, update, candidate. Matrix products run in the compute
    dtype (autocast's), the rest in float32.
    """

    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.input, self.memory = nn.Linear(width, 3 * width), nn.Linear(width, 3 * width)
        for layer in (self.input, self.memory):
            nn.init.zeros_(layer.bias)
            for block in layer.weight.split(width):
                nn.init.orthogonal_(block)

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        return arrdict(output=torch.zeros(n_lanes, self.width, device=device))

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict
    ) -> tuple[torch.Tensor, arrdict]:
        from_input, output, outputs = self.input(x), state["output"], []
        for t in range(len(x)):
            output = output.masked_fill(reset[t, :, None], 0.0)
            r_in, z_in, n_in = from_input[t].float().chunk(3, -1)
            r, z, n = self.memory(output).float().chunk(3, -1)
            candidate = (n_in + (r_in + r).sigmoid() * n).tanh()
            output = candidate.lerp(output, (z_in + z).sigmoid())
            outputs.append(output)
        return torch.stack(outputs).to(from_input.dtype), arrdict(output=output)


class Feedforward(nn.Module):
    """No memory: a hidden layer in the place of one. What is seen now decides alone."""

    def __init__(self, width: int):
        super().__init__()
        self.hidden = nn.Linear(width, width)
        nn.init.orthogonal_(self.hidden.weight, gain=2**0.5)
        nn.init.zeros_(self.hidden.bias)

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        return arrdict()

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict
    ) -> tuple[torch.Tensor, arrdict]:
        return self.hidden(x).relu(), state


CORES = {"lstm": LSTM, "gru": GRU, "mingru": MinGRU, "none": Feedforward}


class Stack(nn.ModuleList):
    """Cores one above the other, each added to what it was given (He et al. 2016), and together a
    core: its outputs are the sum of theirs. Its state is that of each, by its number.
    """

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        return arrdict({str(i): core.initial(n_lanes, device) for i, core in enumerate(self)})

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict
    ) -> tuple[torch.Tensor, arrdict]:
        total, after = None, arrdict()
        for i, core in enumerate(self):
            given = x if total is None else x + total
            outputs, after[str(i)] = core(given, reset, state[str(i)])
            total = outputs if total is None else total + outputs
        return total, after


def make_core(name: str, width: int, layers: int = 1) -> nn.Module:
    """The core called `name`: one of `CORES`, or an import path; or a `Stack` of `layers` of
    them. ValueError that names the clause, if it is not as the head of this file says.
    """
    made = resolve(name, CORES)
    cores = [made(width) for _ in range(layers)]
    if ":" in name:
        _check(name, cores[0], width)
    return cores[0] if layers == 1 else Stack(cores)


@torch.no_grad()
def _check(name, core, width, n_steps=3, n_lanes=2):
    _require(name, hasattr(core, "initial"), "it has a method initial(B, device)")
    state = core.initial(n_lanes, "cpu")
    _require(name, isinstance(state, arrdict), "a state is an arrdict of tensors")
    _require(name, all(len(leaf) == n_lanes for leaf in leaves(state)), "it has a row per lane")
    generator = torch.Generator().manual_seed(1)
    x, other = torch.randn(2, n_steps, n_lanes, width, generator=generator)
    other[1:] = x[1:]
    reset = torch.zeros(n_steps, n_lanes, dtype=torch.bool)
    reset[1] = True
    (outputs, after), (others, _) = core(x, reset, state), core(other, reset, state)
    shape = tuple(outputs.shape)
    _require(
        name,
        shape == (n_steps, n_lanes, width),
        f"outputs are (T, B, width), here {(n_steps, n_lanes, width)}, not {shape}",
    )
    _require(name, _shapes(after) == _shapes(state), "a state is like the one before it")
    _require(name, torch.equal(outputs[1:], others[1:]), "what came before a reset is forgotten")


def _shapes(tree):
    if isinstance(tree, dict):
        return {key: _shapes(child) for key, child in tree.items()}
    return tuple(tree.shape)


def _require(name, kept, clause):
    if not kept:
        raise ValueError(f"{name} breaks the contract of recurrent cores: {clause}")
