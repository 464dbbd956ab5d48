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
SKIPPED = "env", "metadata", "spec", "_np_random", "recorded_return"
SEQUENCES = list, tuple, collections.deque
#: What a wrapper may refer to without owning it.
OTHERS = gymnasium.Env, gymnasium.Space, types.ModuleType, type


def wrapper_state(env: Any, paths: Collection[str] | None = None) -> Tree:
    """Returns copies of the numbers, the arrays and the lists of numbers in wrappers by path, or of
    some, such as `0.NormalizeObservation.obs_rms.mean`; wrapper 0 is the outermost.
    """
    state = {
        f"{place}.{name}": value
        for place, owner in _owners(env).items()
        for name, value in _members(owner).items()
        if _is_value(value)
    }
    return {p: copy.deepcopy(value) for p, value in state.items() if paths is None or p in paths}


def load_wrapper_state(env: Any, state: Tree) -> None:
    """Puts a `wrapper_state`, which may be a stranger's, into the wrappers of another environment.
    Raises ValueError if it is not in such wrappers.
    """
    owners = _owners(env)
    for path, value in state.items():
        place, _, name = path.rpartition(".")
        if place not in owners or not _is_name(name) or not _is_value(value, is_nested=True):
            kind = path.split(".")[1:2]
            raise ValueError(
                f"the agent needs what its wrapper {''.join(kind)} has learnt, and this "
                "environment is in other wrappers; give env.wrappers as in training"
            )
        owner = owners[place]
        now = _members(owner).get(name)
        if isinstance(now, np.ndarray) or isinstance(value, np.ndarray):
            value = np.array(value, getattr(now, "dtype", None))
        elif isinstance(now, collections.deque):
            value = collections.deque(value, now.maxlen)
        elif now is not None:
            value = type(now)(value)
        if isinstance(now, np.ndarray) and now.shape == np.shape(value):
            np.copyto(now, value)
        elif isinstance(owner, dict):
            owner[name] = value
        else:
            setattr(owner, name, value)


def freeze(env: Any) -> None:
    """Stops the running statistics of Gymnasium's own wrappers."""
    for owner in _owners(env).values():
        if hasattr(type(owner), "update_running_mean"):
            owner.update_running_mean = False


def _owners(env) -> dict[str, Any]:
    """Returns wrappers, and the objects and dicts below them, by path, the outermost first."""
    owners, visited, stack = {}, set(), []
    while "env" in getattr(env, "__dict__", ()) and env.unwrapped is not env:
        stack.insert(0, (f"{len(stack)}.{type(env).__name__}", env))
        env = env.env
    while stack:
        path, owner = stack.pop()
        if id(owner) in visited:
            continue
        visited.add(id(owner))
        owners[path] = owner
        below = _members(owner).items()
        stack += [(f"{path}.{name}", child) for name, child in below if _may_own_values(child)]
    return owners


def _members(owner) -> dict[str, Any]:
    pairs = owner if isinstance(owner, dict) else vars(owner)
    return {name: value for name, value in pairs.items() if _is_name(name)}


def _is_name(key) -> bool:
    is_special = key in SKIPPED or str(key).startswith("__")
    return isinstance(key, str) and key.isidentifier() and not is_special


def _is_value(value, is_nested=False) -> bool:
    """Returns whether it is a number, an array or a list of numbers, or of such lists, which arrays
    are in the files of agents.
    """
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    if isinstance(value, SEQUENCES):
        return all(isinstance(p, numbers.Real) or (is_nested and _is_value(p, True)) for p in value)
    return isinstance(value, (numbers.Real, np.bool_))


def _may_own_values(value) -> bool:
    if isinstance(value, dict):
        return True
    is_other = isinstance(value, OTHERS) or callable(value)
    is_gymnasiums = type(value).__module__.startswith("gymnasium.envs")
    return hasattr(value, "__dict__") and not is_other and not is_gymnasiums
