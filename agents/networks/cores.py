"""Recurrent cores by name: lstm, gru, mingru and none.

A core is a module `Core(width)` with two methods:

- `initial(B, device)` returns the hidden state of B lanes at the start of an episode, an arrdict of
  (B, ...) float32 tensors.
- `forward(x, reset, state)` unrolls over x (T, B, W) from a hidden state. It clears a lane's state
  before each step where reset (T, B) is true, and returns outputs (T, B, W) and the state after the
  last step.

One with an attribute `adds_input` that is true adds x to its outputs if `is_residual=True`.

T time, B lanes, W width.
"""

from typing import Any

import torch
from torch import nn

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.dotdict import leaves
from megastep.imports import resolve

CORES = {
    "lstm": "megastep.agents.networks.lstm:LSTM",
    "gru": "megastep.agents.networks.plain_cores:GRU",
    "mingru": "megastep.agents.networks.mingru:MinGRU",
    "none": "megastep.agents.networks.plain_cores:Feedforward",
}


class Stack(nn.ModuleList):
    """Several cores with residual connections (He et al. 2016), which together are a core.

    The input of each is x plus the outputs of those below, and the output is the sum of all
    outputs. The hidden state holds theirs under "0", "1", ...
    """

    adds_input = True

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the hidden state of B lanes at the start of an episode."""
        cores: list[Any] = [*self]
        return arrdict({str(i): c.initial(n_lanes, device) for i, c in enumerate(cores)})

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict, is_residual: bool = False
    ) -> tuple[torch.Tensor, arrdict]:
        """Unrolls over a sequence, as the head of this file says."""
        total, after = None, arrdict()
        # On a GPU each core's kernel adds its input. On a CPU sums keep their order and bits.
        if is_residual and x.is_cuda:
            for i, core in enumerate(self):
                x, after[str(i)] = with_residual(core, x, reset, state[str(i)])
            return x, after
        for i, core in enumerate(self):
            core_input = x if total is None else x + total
            outputs, after[str(i)] = core(core_input, reset, state[str(i)])
            total = outputs if total is None else total + outputs
        assert total is not None
        return x + total if is_residual else total, after


def with_residual(
    core: nn.Module, x: torch.Tensor, reset: torch.Tensor, state: arrdict
) -> tuple[torch.Tensor, arrdict]:
    """Returns x plus the outputs of a core, and its state after the last step."""
    if getattr(core, "adds_input", False):
        return core(x, reset, state, is_residual=True)
    outputs, state = core(x, reset, state)
    return x + outputs, state


def make_core(name: str, width: int, layers: int = 1, activation: str = "relu") -> Any:
    """Returns a recurrent core, a name in `CORES` or an import path; several layers make a `Stack`.
    The activation is that of the core "none". ValueError if there is no such core, or it breaks the
    contract at the head of this file.
    """
    kind = resolve(name, CORES, nn.Module)
    options = {"activation": activation} if name == "none" else {}
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
