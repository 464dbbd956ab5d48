"""Checks the form of what an environment of Gymnasium returns. Workers import it, so without
PyTorch.
"""

import numbers
import re
from collections.abc import Collection, Iterator, Mapping

import numpy as np

from megastep.types import Space, Tree

__all__ = [
    "beyond_bounds",
    "masked_actions",
    "problem_of_error",
    "problem_of_observation",
    "problem_of_result",
]

FORMS = {
    "reset": "(observation, info)",
    "step": "(observation, reward, terminated, truncated, info)",
}


def problem_of_result(
    method: str, result: Tree, space: Space, agents: Collection[str] = ()
) -> str | None:
    """Returns what is wrong with the result of `reset` or `step`, as a clause, None if nothing is.

    Args:
        method: its name.
        result: what it returned.
        space: the observation space.
        agents: of an environment of PettingZoo, each part of whose results is a dict by agent.
    """
    n_values = FORMS[method].count(",") + 1
    if not isinstance(result, (tuple, list)) or len(result) != n_values:
        n = len(result) if isinstance(result, (tuple, list)) else 1
        return f"{method}() must return {FORMS[method]}, and returned {n} value{'s' * (n > 1)}"
    if agents:
        names = FORMS[method].strip("()").split(", ")
        for name, part in zip(names, result):
            if not isinstance(part, Mapping):
                return f"{method}() must return dicts by agent; {name} is {_shown(part)}"
        absent = [None, {}] if method == "reset" else [None, 0.0, False, False, {}]
        for agent in (agent for agent in agents if agent in result[0]):
            own = [part.get(agent, value) for part, value in zip(result, absent)]
            if problem := _problem_of_values(method, own, space):
                return problem
        return None
    return _problem_of_values(method, result, space)


def _problem_of_values(method, result, space) -> str | None:
    if not isinstance(result[-1], Mapping):
        return f"{method}() must return a dict as info, and returned {_shown(result[-1])}"
    if method == "step":
        _, reward, *ends, _ = result
        if np.ndim(reward) or not isinstance(reward, (numbers.Real, np.bool_, np.ndarray)):
            return f"step() must return a number as reward, and returned {_shown(reward)}"
        for name, flag in zip(("terminated", "truncated"), ends):
            if np.ndim(flag) or not isinstance(flag, (numbers.Real, np.bool_, np.ndarray)):
                return f"step() must return a bool as {name}, and returned {_shown(flag)}"
    problem = problem_of_observation(space, result[0])
    return problem and f"{method}() returned an observation that is not in its space: {problem}"


def problem_of_error(method: str, error: Exception) -> str | None:
    """Returns what is wrong with the result of `reset` or `step` that a wrapper could not unpack,
    as a clause, None if the error tells of something else.
    """
    if not re.search("values? to unpack|cannot unpack", str(error)):
        return None
    return f"{method}() must return {FORMS[method]}, and returned something else ({error})"


def masked_actions(space: Space, info: object) -> int:
    """Returns the number of actions that ``info["action_mask"]`` tells of: 0 if there is none, -1
    if it is not a number per action of a Discrete space.
    """
    mask = info.get("action_mask") if isinstance(info, Mapping) else None
    if mask is None:
        return 0
    from gymnasium import spaces

    n = int(space.n) if isinstance(space, spaces.Discrete) else 0
    try:
        return n if n and np.shape(mask) == (n,) else -1
    except ValueError:  # of parts with different shapes
        return -1


def beyond_bounds(space: Space, batch: Tree, path: str = "it") -> Iterator[tuple[str, bool]]:
    """Yields which observations of a batch are beyond the bounds of their space, as clauses, and
    whether the space is a Box, by whose bounds nothing is scaled.

    Args:
        space: of one observation.
        batch: observations of B lanes.
        path: the observation's name in clauses.
    """
    from gymnasium import spaces

    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        for key, part in space.items() if isinstance(space, spaces.Dict) else enumerate(space):
            yield from beyond_bounds(part, batch[key], f"its part {key!r}")
        return
    is_box = isinstance(space, spaces.Box)
    if is_box:
        low, high = space.low, space.high
    elif isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        n = space.n if isinstance(space, spaces.Discrete) else space.nvec
        low, high = space.start, space.start + n - 1
    elif isinstance(space, spaces.MultiBinary):
        low, high = 0, 1
    else:
        return
    beyond = (batch < low) | (batch > high)
    if beyond.any():
        beyond &= ~(np.isclose(batch, low) | np.isclose(batch, high))  # rounding errors
    for lane, *place in np.argwhere(beyond)[:1]:
        yield f"{path} has {batch[(lane, *place)]} in lane {lane}, and the space is {space}", is_box


def problem_of_observation(space: Space, value: Tree, path: str = "it") -> str | None:
    """Returns why a value is not in a space of Gymnasium's, as a clause, None if it is.

    Leaves numbers beyond the bounds of a Box to `beyond_bounds`, and lets their dtype be.
    """
    from gymnasium import spaces

    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        is_dict = isinstance(space, spaces.Dict)
        if not isinstance(value, Mapping if is_dict else (tuple, list)):
            return f"{path} must be a {'dict' if is_dict else 'tuple'}, not {_shown(value)}"
        trees: tuple = space.spaces, value
        parts, values = (tree if is_dict else dict(enumerate(tree)) for tree in trees)
        if parts.keys() != values.keys():
            return f"{path} must have {[*parts]}, not {[*values]}"
        problems = (problem_of_observation(parts[k], values[k], f"its part {k!r}") for k in parts)
        return next(filter(None, problems), None)
    if not isinstance(
        space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    ):
        return None if space.contains(value) else f"{path} is {_shown(value)}"
    shape = space.shape or ()
    try:
        array = np.asarray(value)
    except ValueError:  # of parts with different shapes
        return f"{path} must be an array of shape {shape}, not {_shown(value)}"
    if array.shape != shape or array.dtype.kind not in "biuf":
        kind = "an array" if shape else "a number"
        return f"{path} must be {kind} of shape {shape}, not {_shown(value)}"
    if isinstance(space, spaces.Box):
        return None
    start, n = getattr(space, "start", 0), 2  # of MultiBinary
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        n = space.n if isinstance(space, spaces.Discrete) else space.nvec
    if not ((array >= start) & (array < start + n) & (array % 1 == 0)).all():
        return f"{path} is {_shown(value)}, and the space is {space}"
    return None


def _shown(value) -> str:
    if isinstance(value, np.ndarray) and value.size > 4:
        return f"an array of shape {value.shape}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"a {type(value).__name__}"
