"""An episode of random actions in an environment of Gymnasium, which finds what cannot be asked of
it, and what its wrappers keep, such as running statistics. Workers import it, so without PyTorch.
"""

import collections
import contextlib
import copy
import numbers
import time
import types
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from megastep.global_generators import KINDS, GlobalGenerators, kept
from megastep.hosting.values import masked_actions
from megastep.types import Tree

#: Name of the sum of an episode's rewards before wrappers change them.
TRUE_RETURN = "true_return"
#: Steps and seconds of the episode.
MAX_STEPS, MAX_SECONDS = 1000, 5.0

#: Attributes of a wrapper that are no state of its own.
SKIPPED = "env", "metadata", "spec", "_np_random", "recorded_return"
SEQUENCES = list, tuple, collections.deque
#: What a wrapper may refer to without owning it.
OTHERS = gymnasium.Env, gymnasium.Space, types.ModuleType, type


class Probe(NamedTuple):
    """What an episode has shown.

    Attributes:
        names: keys of the numbers in its last ``info``, `is_success` first; before them
            `TRUE_RETURN`, if wrappers change rewards.
        generators: kinds of global generators that the environment draws from.
        learnt: paths of what wrappers keep beyond an episode, see `wrapper_state`.
        n_masked: actions of the mask in ``info["action_mask"]``, see `masked_actions`.
    """

    names: tuple[str, ...] = ()
    generators: tuple[str, ...] = ()
    learnt: tuple[str, ...] = ()
    n_masked: int = 0


class RewardRecorder(gymnasium.Wrapper):
    """Sums an episode's rewards, which wrappers around it may change."""

    recorded_return = 0.0

    def reset(self, **settings: Tree) -> tuple:
        self.recorded_return = 0.0
        return super().reset(**settings)

    def step(self, action: Tree) -> tuple:
        result = super().step(action)
        with contextlib.suppress(TypeError, ValueError):  # which a check names
            self.recorded_return += float(result[1])
        return result

    @classmethod
    def inside(cls, env: Any) -> "RewardRecorder | None":
        """Returns the recorder inside other wrappers, None if there is none."""
        while env is not None and not isinstance(env, cls):
            env = vars(env).get("env")
        return env


def numbers_of(info: object) -> dict[str, float]:
    """Returns the single numbers of an `info` by key."""
    values = {}
    for key, value in info.items() if isinstance(info, Mapping) else ():
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(())[()]
        if isinstance(key, str) and isinstance(value, (numbers.Real, np.bool_)):
            with contextlib.suppress(OverflowError):
                values[key] = float(value)
    return values


def probe(make: Callable, seed: int = 0) -> Probe:
    """Makes an environment, plays an episode of at most `MAX_STEPS` and `MAX_SECONDS`, and closes
    it. Leaves the global generators as they were. An error ends the episode: the same one comes in
    training, which names it.
    """
    names, first, last, total, is_changed, n_masked = [], {}, {}, 0.0, False, 0
    with kept():
        env = make()
        recorder = RewardRecorder.inside(env)
        drawn, fresh = GlobalGenerators([seed]), GlobalGenerators([seed])
        with contextlib.suppress(Exception), drawn.installed(KINDS):
            n_masked = masked_actions(env.action_space, env.reset(seed=seed)[1])
            first, end = wrapper_state(env), time.monotonic() + MAX_SECONDS
            actions = copy.deepcopy(env.action_space)  # which may be that of a class
            actions.seed(seed)
            for _ in range(MAX_STEPS):
                _, reward, terminated, truncated, info = env.step(actions.sample())
                total += float(reward)
                is_changed = recorder is not None and recorder.recorded_return != total
                names = sorted(numbers_of(info), key=lambda name: name != "is_success")
                if terminated or truncated or time.monotonic() > end:
                    break
        before = fresh.states()
        generators = tuple(kind for kind, state in drawn.states().items() if state != before[kind])
        # what a new episode draws is the same
        with contextlib.suppress(Exception), fresh.installed(KINDS):
            env.reset(seed=seed)
            last = wrapper_state(env)
        with contextlib.suppress(Exception):
            env.close()
    learnt = (p for p in last if p not in first or not np.array_equal(last[p], first[p]))
    names = [name for name in names if name != TRUE_RETURN]
    names = [TRUE_RETURN, *names] if is_changed else names
    return Probe(tuple(names), generators, tuple(learnt), n_masked)


# ---- What wrappers keep ----


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
