"""What the wrappers around an environment of Gymnasium or PettingZoo keep in their attributes, such
as running statistics: to read it, and to put it into other wrappers of the same classes. Workers
import it, so without PyTorch.
"""

import collections
import copy
import numbers
import types
from collections.abc import Collection, Iterator
from typing import Any

import gymnasium
import numpy as np

from megastep.types import Tree

__all__ = ["give_state", "load_wrapper_state", "wrapper_state"]

#: Attributes of a wrapper that are no state of its own.
SKIPPED = "env", "metadata", "spec", "_np_random", "recorded_reward"
SEQUENCES = list, tuple, collections.deque


def wrapper_state(env: Any, paths: Collection[str] | None = None) -> Tree:
    """Returns copies of the numbers, the arrays and the lists of numbers in wrappers by path, such
    as `0.NormalizeObservation.obs_rms.mean`; wrapper 0 is the outermost.

    Args:
        paths: those wanted. None: all.
    """
    visited = set()
    return {
        path: copy.deepcopy(value)
        for place, wrapper in _wrappers(env)
        for path, value in _values(place, wrapper, visited)
        if paths is None or path in paths
    }


def load_wrapper_state(env: Any, state: Tree) -> None:
    """Puts a `wrapper_state`, which may be a stranger's, into the wrappers of another environment.

    Raises:
        ValueError: it is not in such wrappers.
    """
    wrappers = dict(_wrappers(env))
    for path, value in state.items():
        number, kind, *keys, last = path.split(".") if _is_safe(path, value) else ("", "", "")
        holder = wrappers.get(f"{number}.{kind}")
        for key in keys:
            holder = _children(holder).get(key)
        if holder is None:
            raise ValueError(
                f"the agent needs what its wrapper {kind} has learnt, and this environment is in "
                "other wrappers; give env.wrappers as in training"
            )
        now = _children(holder).get(last)
        if isinstance(now, np.ndarray) or isinstance(value, np.ndarray):
            value = np.array(value, getattr(now, "dtype", None))
        elif isinstance(now, collections.deque):
            value = collections.deque(value, now.maxlen)
        elif now is not None:
            value = type(now)(value)
        if isinstance(now, np.ndarray) and now.shape == np.shape(value):
            np.copyto(now, value)
        elif isinstance(holder, dict):
            holder[last] = value
        else:
            setattr(holder, last, value)


def give_state(env: Any, state: Tree, is_frozen: bool) -> Tree:
    """Puts a `wrapper_state` into the wrappers of an environment. With `is_frozen`, stops the
    running statistics of Gymnasium's own, and returns the state, to be put there after each step.
    """
    load_wrapper_state(env, state)
    for _, wrapper in _wrappers(env) if is_frozen else ():
        if hasattr(type(wrapper), "update_running_mean"):
            wrapper.update_running_mean = False
    return state if is_frozen else None


def _is_safe(path, value) -> bool:
    """Returns whether a part of a state is numbers for an attribute that is not special."""
    _, *names = str(path).split(".")
    is_special = any(name.startswith("__") or name in SKIPPED for name in names)
    is_named = len(names) > 1 and all(name.isidentifier() for name in names)
    return is_named and not is_special and _are_numbers(value)


def _are_numbers(value) -> bool:
    is_nested = isinstance(value, SEQUENCES)  # as arrays are in the files of agents
    return all(map(_are_numbers, value)) if is_nested else _is_value(value)


def _wrappers(env) -> Iterator[tuple]:
    """Yields (number and class, wrapper), the outermost first."""
    number = 0
    while "env" in getattr(env, "__dict__", ()) and env.unwrapped is not env:
        yield f"{number}.{type(env).__name__}", env
        env, number = env.env, number + 1


def _children(node) -> dict:
    return node if isinstance(node, dict) else getattr(node, "__dict__", {})


def _values(path, node, visited) -> Iterator[tuple]:
    """Yields (path, value) of all below an object."""
    if id(node) in visited:
        return
    visited.add(id(node))
    for key, value in _children(node).items():
        if not isinstance(key, str) or not key.isidentifier() or key in SKIPPED:
            continue
        if _is_value(value):
            yield f"{path}.{key}", value
        elif _has_values(value):
            yield from _values(f"{path}.{key}", value, visited)


def _is_value(value) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    if isinstance(value, SEQUENCES):
        return all(isinstance(part, numbers.Real) for part in value)
    return isinstance(value, (numbers.Real, np.bool_))


def _has_values(value) -> bool:
    """Returns whether a value may be a wrapper's own object: no environment, space or function."""
    others = gymnasium.Env, gymnasium.Space, types.ModuleType, type
    is_other = isinstance(value, others) or callable(value) or hasattr(value, "possible_agents")
    is_gymnasiums = type(value).__module__.startswith("gymnasium.envs")
    is_object = hasattr(value, "__dict__") and not is_other and not is_gymnasiums
    return isinstance(value, dict) or is_object
