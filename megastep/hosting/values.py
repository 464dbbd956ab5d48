"""Checks of observations and action masks. Workers import it, so without PyTorch."""

from collections.abc import Iterator, Mapping

import numpy as np
from gymnasium import spaces

from megastep.hosting.env_error import BadValue
from megastep.types import Space, Tree

__all__ = ["CHECKED_STEPS", "allowed_actions", "beyond_bounds", "masked_actions"]

#: Steps in which observations are compared with their space.
CHECKED_STEPS = 100


def beyond_bounds(space: Space, batch: Tree, path: str = "it") -> Iterator[tuple[str, bool]]:
    """Yields a clause for an observation beyond its space, and whether that is a Box."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        for key, part in space.items() if isinstance(space, spaces.Dict) else enumerate(space):
            yield from beyond_bounds(part, batch[key], f"its part {key!r}")
        return
    is_box, low, high = isinstance(space, spaces.Box), 0, 1  # as of MultiBinary
    if is_box:
        low, high = space.low, space.high
    elif isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        n = space.n if isinstance(space, spaces.Discrete) else space.nvec
        low, high = space.start, space.start + n - 1
    beyond = (batch < low) | (batch > high)
    if beyond.any():
        beyond &= ~(np.isclose(batch, low) | np.isclose(batch, high))  # rounding errors
    for lane, *place in np.argwhere(beyond)[:1]:
        yield f"{path} has {batch[(lane, *place)]} in lane {lane}, and the space is {space}", is_box


def masked_actions(space: Space, info: object) -> int:
    """Returns the number of actions of ``info["action_mask"]``; 0: none, -1: of no Discrete."""
    mask = info.get("action_mask") if isinstance(info, Mapping) else None
    if mask is None:
        return 0
    n = int(space.n) if isinstance(space, spaces.Discrete) else 0
    try:
        return n if n and np.shape(mask) == (n,) else -1
    except ValueError:  # of parts with different shapes
        return -1


def allowed_actions(info: Mapping, n: int, place: str) -> np.ndarray:
    """Returns an info's mask, (n,) bool; one that allows nothing allows all. BadValue."""
    mask = np.asarray(info.get("action_mask", np.ones(n)), bool)
    if mask.shape != (n,):
        clause = f"info['action_mask'] has shape {mask.shape}, and before it had ({n},)"
        raise BadValue.of(clause, place)
    return mask if mask.any() else np.ones(n, bool)
