"""Spaces and values as other libraries have them. B lanes; an axis of one agent per lane is left
out.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch

from megastep import spaces
from megastep.dotdict import mapping
from megastep.types import Space, Tree

NUMPY: Any = {torch.float16: np.float16, torch.float32: np.float32}


def gymnasium_space(space: Space, dtype: torch.dtype) -> gymnasium.Space:
    """Returns Gymnasium's space of one lane's actions, or observations with floats of a dtype."""
    if isinstance(space, Mapping):
        parts = {key: gymnasium_space(part, dtype) for key, part in space.items()}
        return gymnasium.spaces.Dict(parts)
    shape = space.shape[1:] if space.shape[0] == 1 else space.shape
    if isinstance(space, spaces.MultiDiscrete):
        if not shape:
            return gymnasium.spaces.Discrete(space.n_actions)
        return gymnasium.spaces.MultiDiscrete([space.n_actions] * space.n_agents)
    is_action = isinstance(space, spaces.MultiContinuous)
    pair = space.tensors() if is_action else space.bounds()
    low, high = (bound.expand(space.shape).reshape(shape).numpy() for bound in pair)
    kind = np.float32 if is_action else NUMPY[dtype]
    if space.dtype == torch.uint8:
        low, high, kind = np.clip(low, 0, 255), np.clip(high, 0, 255), np.uint8
    return gymnasium.spaces.Box(low.astype(kind), high.astype(kind), dtype=kind)


def without_agents(space: Space, values: Tree) -> Tree:
    """Returns observations (B, ...) or masks (B, A, n), a tensor or a dict of those of some parts
    of a space, without an axis of one agent per lane.
    """
    if isinstance(values, Mapping):
        return {key: without_agents(space[key], part) for key, part in values.items()}
    return values[:, 0] if space.shape[0] == 1 else values


@mapping
def as_dtype(leaf: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Returns a tree of tensors whose floats are of a dtype."""
    return leaf.to(dtype) if leaf.is_floating_point() else leaf


@mapping
def to_numpy(leaf: torch.Tensor) -> np.ndarray:
    """Returns a tree of tensors as arrays that share no memory with them."""
    return leaf.detach().to("cpu", copy=True).numpy()


@mapping
def row(leaf: Tree, lane: int | np.integer) -> Tree:
    """Returns one lane's values of a batch."""
    return leaf[lane]
