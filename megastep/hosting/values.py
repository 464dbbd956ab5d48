"""Checks the form of what environments of Gymnasium and PettingZoo return. Workers import it, so
without PyTorch.
"""

import numbers
from collections.abc import Collection, Iterator, Mapping

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array

from megastep.hosting.env_error import BadValue, one_line
from megastep.types import Space, Tree

__all__ = ["CHECKED_STEPS", "allowed_actions", "beyond_bounds", "masked_actions", "problem"]

#: Steps of each environment in which the form of its values is checked.
CHECKED_STEPS = 100
FORMS = {
    "reset": "(observation, info)",
    "step": "(observation, reward, terminated, truncated, info)",
}
#: Of an agent that a part of a result leaves out.
ABSENT = {"reset": (None, {}), "step": (None, 0.0, False, False, {})}


def problem(
    method: str, result: Tree, space: Space, agents: Collection[str] | None = None
) -> str | None:
    """Returns what is wrong with the result of `reset` or `step`, as a clause, None if nothing is,
    but for numbers beyond the bounds of the observation space. With `agents`, of PettingZoo, each
    part of the result is a dict by agent.
    """
    names = FORMS[method].strip("()").split(", ")
    if not isinstance(result, (tuple, list)) or len(result) != len(names):
        n = len(result) if isinstance(result, (tuple, list)) else 1
        return f"{method}() must return {FORMS[method]}, and returned {n} value{'s' * (n > 1)}"
    if agents is None:
        return _problem_of_one(method, result, space)
    for name, part in zip(names, result):
        if not isinstance(part, Mapping):
            return f"{method}() must return dicts by agent; {name} is {_shown(part)}"
    for agent in (agent for agent in agents if agent in result[0]):
        values = [part.get(agent, absent) for part, absent in zip(result, ABSENT[method])]
        if found := _problem_of_one(method, values, space):
            return found
    return None


def _problem_of_one(method, values, space) -> str | None:
    obs, *outcomes, info = values
    if not isinstance(info, Mapping):
        return f"{method}() must return a dict as info, and returned {_shown(info)}"
    kinds = ("a number as reward", "a bool as terminated", "a bool as truncated")
    for kind, value in zip(kinds, outcomes):
        if np.ndim(value) or not isinstance(value, (numbers.Real, np.bool_, np.ndarray)):
            return f"step() must return {kind}, and returned {_shown(value)}"
    try:
        concatenate(space, [obs], create_empty_array(space, 1))
    except Exception as error:
        text = " ".join(str(space).split())
        return (
            f"{method}() returned an observation that is not in its space, {text[:100]}: "
            f"{_shown(obs)} ({one_line(error)})"
        )
    return None


def beyond_bounds(space: Space, batch: Tree, path: str = "it") -> Iterator[tuple[str, bool]]:
    """Yields which observations of a batch (B, ...) are beyond the bounds of their space, as
    clauses, and whether the space is a Box, by whose bounds nothing is scaled.
    """
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
    """Returns the number of actions of the mask ``info["action_mask"]``: 0 if there is none, -1 if
    it is not a number per action of a Discrete space.
    """
    mask = info.get("action_mask") if isinstance(info, Mapping) else None
    if mask is None:
        return 0
    n = int(space.n) if isinstance(space, spaces.Discrete) else 0
    try:
        return n if n and np.shape(mask) == (n,) else -1
    except ValueError:  # of parts with different shapes
        return -1


def allowed_actions(info: Mapping, n: int, place: str) -> np.ndarray:
    """Returns the mask of an ``info``, (n,) bool. None, or one that allows nothing, as at an
    episode's end, allows all. Raises BadValue if it has another shape.
    """
    mask = np.asarray(info.get("action_mask", np.ones(n)), bool)
    if mask.shape != (n,):
        clause = f"info['action_mask'] has shape {mask.shape}, and before it had ({n},)"
        raise BadValue.of(clause, place)
    return mask if mask.any() else np.ones(n, bool)


def _shown(value) -> str:
    if isinstance(value, np.ndarray) and value.size > 4:
        return f"an array of shape {value.shape}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"a {type(value).__name__}"
