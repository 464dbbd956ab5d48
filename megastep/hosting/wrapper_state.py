"""What the wrappers around an environment of Gymnasium keep in their attributes, such as running
statistics. Workers import it, so without PyTorch.
"""

import collections
import copy
import numbers
import types
from collections.abc import Collection
from typing import Any

import gymnasium
import numpy as np

from megastep.types import Tree

__all__ = ["freeze", "load_wrapper_state", "wrapper_state"]

#: Attributes of a wrapper that are no state of its own.
SKIPPED = "env", "metadata", "spec", "_np_random", "recorded_reward"
SEQUENCES = list, tuple, collections.deque
#: What a wrapper may refer to without owning it.
OTHERS = gymnasium.Env, gymnasium.Space, types.ModuleType, type


def wrapper_state(env: Any, paths: Collection[str] | None = None) -> Tree:
    """Returns copies of the numbers, the arrays and the lists of numbers in wrappers by path, or of
    some, such as `0.NormalizeObservation.obs_rms.mean`; wrapper 0 is the outermost.
    """
    found, visited, stack = {}, set(), [*reversed(_wrappers(env).items())]
    while stack:
        place, node = stack.pop()
        if id(node) in visited:
            continue
        visited.add(id(node))
        for key, value in _children(node).items():
            path = f"{place}.{key}"
            if not isinstance(key, str) or not key.isidentifier() or key in SKIPPED:
                continue
            if _is_value(value):
                found[path] = value
            elif _may_own_values(value):
                stack.append((path, value))
    wanted = found if paths is None else [path for path in found if path in paths]
    return {path: copy.deepcopy(found[path]) for path in wanted}


def load_wrapper_state(env: Any, state: Tree) -> None:
    """Puts a `wrapper_state`, which may be a stranger's, into the wrappers of another environment.
    Raises ValueError if it is not in such wrappers.
    """
    wrappers = _wrappers(env)
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


def freeze(env: Any) -> None:
    """Stops the running statistics of Gymnasium's own wrappers."""
    for wrapper in _wrappers(env).values():
        if hasattr(type(wrapper), "update_running_mean"):
            wrapper.update_running_mean = False


def _is_safe(path, value) -> bool:
    """Returns whether a part of a state is numbers for an attribute that is not special."""
    _, *names = str(path).split(".")
    is_special = any(name.startswith("__") or name in SKIPPED for name in names)
    is_named = len(names) > 1 and all(name.isidentifier() for name in names)
    return is_named and not is_special and _are_numbers(value)


def _are_numbers(value) -> bool:
    is_nested = isinstance(value, SEQUENCES)  # as arrays are in the files of agents
    return all(map(_are_numbers, value)) if is_nested else _is_value(value)


def _wrappers(env) -> dict[str, Any]:
    """Returns wrappers by number and class, the outermost first."""
    wrappers = {}
    while "env" in getattr(env, "__dict__", ()) and env.unwrapped is not env:
        wrappers[f"{len(wrappers)}.{type(env).__name__}"] = env
        env = env.env
    return wrappers


def _children(node) -> dict:
    return node if isinstance(node, dict) else getattr(node, "__dict__", {})


def _is_value(value) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    if isinstance(value, SEQUENCES):
        return all(isinstance(part, numbers.Real) for part in value)
    return isinstance(value, (numbers.Real, np.bool_))


def _may_own_values(value) -> bool:
    if isinstance(value, dict):
        return True
    is_other = isinstance(value, OTHERS) or callable(value)
    is_gymnasiums = type(value).__module__.startswith("gymnasium.envs")
    return hasattr(value, "__dict__") and not is_other and not is_gymnasiums
