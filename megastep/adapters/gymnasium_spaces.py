"""Spaces and values as other libraries have them. B lanes; an axis of one agent per lane is left
out.
"""

from collections.abc import Mapping, Sequence

import gymnasium
import numpy as np
import torch

from megastep import spaces
from megastep.types import Space, Tree

__all__ = ["action_mask", "gymnasium_space", "int8", "row", "stacked", "to_numpy", "without_agents"]

NUMPY = {torch.uint8: np.uint8, torch.float16: np.float16, torch.float32: np.float32}


def gymnasium_space(space: Space, dtype: torch.dtype) -> gymnasium.Space:
    """Returns Gymnasium's space of one lane.

    Args:
        space: of observations or actions.
        dtype: of observations whose space names no other than float16 and float32.
    """
    if isinstance(space, Mapping):
        parts = {key: gymnasium_space(part, dtype) for key, part in space.items()}
        return gymnasium.spaces.Dict(parts)
    shape = space.shape[1:] if space.shape[0] == 1 else space.shape
    if isinstance(space, spaces.MultiDiscrete):
        if not shape:
            return gymnasium.spaces.Discrete(space.n_actions)
        return gymnasium.spaces.MultiDiscrete([space.n_actions] * space.n_agents)
    if isinstance(space, spaces.MultiContinuous):
        low, high = (bound.expand(space.shape).reshape(shape).numpy() for bound in space.tensors())
        return gymnasium.spaces.Box(low, high, dtype=np.float32)
    is_bytes = space.dtype == torch.uint8
    low, high = (bound.expand(space.shape).reshape(shape).numpy() for bound in space.bounds())
    if is_bytes:
        low, high = np.clip(low, 0, 255), np.clip(high, 0, 255)
    kind = NUMPY[torch.uint8 if is_bytes else dtype]
    return gymnasium.spaces.Box(low.astype(kind), high.astype(kind), dtype=kind)


def without_agents(space: Space, values: Tree, dtype: torch.dtype | None = None) -> Tree:
    """Returns observations (B, ...) as a dict of tensors, without an axis of one agent per lane.

    Args:
        space: of the observations.
        dtype: of those in floats; None leaves them.
    """
    if isinstance(space, Mapping):
        return {key: without_agents(part, values[key], dtype) for key, part in space.items()}
    values = values[:, 0] if space.shape[0] == 1 else values
    return values.to(dtype) if dtype and values.is_floating_point() else values


def action_mask(space: Space, mask: Tree) -> Tree:
    """Returns the mask (B, A, n) bool of a world, or a dict of those of some action spaces, without
    an axis of one agent per lane.
    """
    if isinstance(mask, Mapping):
        return {key: action_mask(space[key], part) for key, part in mask.items()}
    return mask[:, 0] if space.shape[0] == 1 else mask


def to_numpy(tree: Tree) -> Tree:
    """Returns a tree of tensors as arrays that share no memory with them."""
    if isinstance(tree, Mapping):
        return {key: to_numpy(part) for key, part in tree.items()}
    return tree.detach().to("cpu", copy=True).numpy()


def int8(tree: Tree) -> Tree:
    """Returns a tree of arrays as int8, as Gymnasium's spaces take masks."""
    if isinstance(tree, Mapping):
        return {key: int8(part) for key, part in tree.items()}
    return tree.astype(np.int8)


def row(tree: Tree, lane: int | np.integer) -> Tree:
    """Returns one lane's values of a batch."""
    if isinstance(tree, Mapping):
        return {key: row(part, lane) for key, part in tree.items()}
    return tree[lane]


def stacked(rows: Sequence[Tree]) -> Tree:
    """Returns the values of lanes as a batch of arrays."""
    if isinstance(rows[0], Mapping):
        return {key: stacked([one[key] for one in rows]) for key in rows[0]}
    return np.stack(rows)
