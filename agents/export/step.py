"""One step of a policy as a function of tensors alone, for other runtimes.

B lanes. Inputs in this order: `obs` or `obs.NAME` for each leaf of the observation; `mask` or
`mask.NAME`, if the environment has action masks; `reset`; and `state.0`, `state.1`, ... for the
leaves of the hidden state. Outputs: `action`, `logits` (or `action.NAME`, `logits.NAME`) and
`next_state.0`, ...
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import nn

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.dotdict import leaves, mapping
from megastep.types import Space, Tree

if TYPE_CHECKING:
    from megastep.agents.networks.policy import Policy

#: Of the floating-point inputs.
FLOAT = torch.float32


class Port(NamedTuple):
    """An input or output.

    Attributes:
        name: as at the head of this file.
        shape: without the axis B.
        dtype: of PyTorch, without `torch.`.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str


class Step(nn.Module):
    """Acts greedily for one step, as `policy(world, state, sample=False)` does on a CPU.

    Args:
        policy: the policy, which acts.
        obs_space: its observation space.
        mask: an action mask of the environment. None: it has none.

    Attributes:
        inputs, outputs: the ports, in order.
    """

    def __init__(self, policy: "Policy", obs_space: Space, mask: Tree = None):
        super().__init__()
        self.policy, self.obs_space = policy.actor().eval(), obs_space
        self.masks = {} if mask is None else spaces.leaves(mask)
        self.example = self.tensors(self._world(2), self.policy.initial(2))
        self.inputs = [*map(_port, self._input_names(), self.example)]
        self.outputs = [*map(_port, self._output_names(), self(*self.example))]

    @torch.no_grad()
    def forward(self, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Returns the outputs for the inputs, (B, ...) each."""
        obs, mask, reset, state = self._trees(tensors)
        obs = mapping(torch.unsqueeze)(obs, 0)
        features, state = self.policy._features(obs, reset[None], state)
        logits = self.policy.output.masked(self.policy.output(features[0]), mask)
        actions = self.policy.output.greedy(logits)
        return *leaves(actions), *leaves(logits), *leaves(state)

    def tensors(self, world: arrdict, state: arrdict) -> tuple[torch.Tensor, ...]:
        """Returns the inputs for a world and a hidden state."""
        obs = spaces.leaves(world["obs"])
        values = [obs[path] for path in self.policy.intake.paths]
        values = [leaf.to(FLOAT) if leaf.is_floating_point() else leaf for leaf in values]
        masks = spaces.leaves(world["mask"]) if self.masks else {}
        return *values, *(masks[path] for path in self.masks), world["reset"], *leaves(state)

    def trees(self, outputs: Sequence[torch.Tensor]) -> tuple[list, list, arrdict]:
        """Returns leaves of actions, leaves of logits and the hidden state of outputs."""
        n_state = len(leaves(self.policy.initial(1)))
        n = (len(outputs) - n_state) // 2
        state = _filled(self.policy.initial(1), [*outputs[2 * n :]])
        return [*outputs[:n]], [*outputs[n : 2 * n]], state

    def _world(self, n_lanes) -> arrdict:
        def zeros(space) -> torch.Tensor:
            integers = isinstance(space, spaces.MultiDiscrete)
            dtype = torch.int64 if integers else getattr(space, "dtype", None) or FLOAT
            return torch.zeros(n_lanes, *space.shape, dtype=dtype)

        reset = torch.ones(n_lanes, dtype=torch.bool)
        masks = {path: leaf.new_ones(n_lanes, *leaf.shape[1:]) for path, leaf in self.masks.items()}
        obs = spaces.map(zeros, self.obs_space)
        return arrdict(obs=obs, reset=reset, **({"mask": _nested(masks)} if masks else {}))

    def _trees(self, tensors) -> tuple[Tree, Tree, torch.Tensor, arrdict]:
        paths = self.policy.intake.paths
        n, end = len(paths), len(paths) + len(self.masks)
        mask = _nested(dict(zip(self.masks, tensors[n:end]))) if self.masks else None
        state = _filled(self.policy.initial(1), [*tensors[end + 1 :]])
        return _nested(dict(zip(paths, tensors[:n]))), mask, tensors[end], state

    def _input_names(self) -> list[str]:
        parts = [("obs", self.policy.intake.paths), ("mask", self.masks)]
        names = [f"{kind}.{path}".rstrip(".") for kind, paths in parts for path in paths]
        n_state = len(leaves(self.policy.initial(1)))
        return [*names, "reset", *(f"state.{i}" for i in range(n_state))]

    def _output_names(self) -> list[str]:
        obs, _, _, state = self._trees(self.example)
        logits = self.policy.output(self.policy.intake(mapping(torch.unsqueeze)(obs, 0))[0])
        paths = [*spaces.leaves(logits)]
        names = [f"{kind}.{path}".rstrip(".") for kind in ("action", "logits") for path in paths]
        return [*names, *(f"next_state.{i}" for i in range(len(leaves(state))))]


def _port(name, tensor) -> Port:
    return Port(name, tuple(tensor.shape[1:]), str(tensor.dtype).removeprefix("torch."))


def _filled(tree, values) -> arrdict:
    """Returns a tree with other leaves, taken from the front of a list."""
    return tree.map(lambda leaf: values.pop(0)) if tree else tree


def _nested(flat) -> Tree:
    """Returns the tree of leaves by dotted path."""
    if [*flat] == [""]:
        return flat[""]
    tree: dict = {}
    for path, leaf in flat.items():
        *groups, name = path.split(".")
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
        node[name] = leaf
    return tree
