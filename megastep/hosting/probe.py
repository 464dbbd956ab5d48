"""An episode of random actions, which finds what cannot be asked; statistics of wrappers."""

import contextlib
import copy
import numbers
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from megastep.global_generators import KINDS, GlobalGenerators, kept
from megastep.hosting.env_error import BadValue
from megastep.types import Space, Tree

#: Name of the sum of an episode's rewards before wrappers change them.
TRUE_RETURN = "true_return"
#: Steps and seconds of the episode.
MAX_STEPS, MAX_SECONDS = 1000, 5.0

#: Attributes of running statistics, as Gymnasium's `RunningMeanStd` has them.
PARTS = "mean", "var", "count"


class Probe(NamedTuple):
    """What an episode has shown."""

    #: Keys of the numbers in its last ``info``, `is_success` first; before them `TRUE_RETURN`, if
    #: wrappers change rewards.
    names: tuple[str, ...] = ()
    generators: tuple[str, ...] = ()  # kinds of global ones that the environment draws from
    n_masked: int = 0  # see `masked_actions`


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
    """Plays an episode, of `MAX_STEPS` and `MAX_SECONDS` at most, which an error ends."""
    names, total, is_changed, n_masked = [], 0.0, False, 0
    with kept():
        env = make()
        recorder, drawn = RewardRecorder.inside(env), GlobalGenerators([seed])
        with contextlib.suppress(Exception), drawn.installed(KINDS):
            n_masked = masked_actions(env.action_space, env.reset(seed=seed)[1])
            end = time.monotonic() + MAX_SECONDS
            actions = copy.deepcopy(env.action_space)  # which may be that of a class
            actions.seed(seed)
            for _ in range(MAX_STEPS):
                _, reward, terminated, truncated, info = env.step(actions.sample())
                total += float(reward)
                is_changed = recorder is not None and recorder.recorded_return != total
                names = sorted(numbers_of(info), key=lambda name: name != "is_success")
                if terminated or truncated or time.monotonic() > end:
                    break
        before = GlobalGenerators([seed]).states()
        generators = tuple(kind for kind, state in drawn.states().items() if state != before[kind])
        with contextlib.suppress(Exception):
            env.close()
    names = [name for name in names if name != TRUE_RETURN]
    names = [TRUE_RETURN, *names] if is_changed else names
    return Probe(tuple(names), generators, n_masked)


# ---- Checks of observations and action masks ----

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


# ---- Running statistics in wrappers ----


def _wrappers(env) -> Iterator[Any]:
    """Yields wrappers, the outermost first."""
    while "env" in getattr(env, "__dict__", ()) and env.unwrapped is not env:
        yield env
        env = env.env


def _statistics(env) -> dict[str, Any]:
    """Returns the objects with `PARTS` in wrappers by path, `0.NormalizeReward.return_rms`."""
    return {
        f"{number}.{type(wrapper).__name__}.{name}": value
        for number, wrapper in enumerate(_wrappers(env))
        for name, value in vars(wrapper).items()
        if all(hasattr(value, part) for part in PARTS)
    }


def wrapper_state(env: Any) -> Tree:
    """Returns copies of the running statistics in wrappers, numbers and arrays by path."""
    owners = _statistics(env).items()
    return {f"{p}.{part}": copy.deepcopy(getattr(one, part)) for p, one in owners for part in PARTS}


def load_wrapper_state(env: Any, state: Tree) -> None:
    """Puts a `wrapper_state`, which may be a stranger's, into other wrappers. ValueError."""
    owners = _statistics(env)
    for path, value in state.items():
        place, _, part = path.rpartition(".")
        if place not in owners or part not in PARTS:
            kind = path.split(".")[1:2]
            raise ValueError(
                f"the agent needs what its wrapper {''.join(kind)} has learnt, and this "
                "environment is in other wrappers; give env.wrappers as in training"
            )
        now = getattr(owners[place], part)
        is_array = isinstance(now, np.ndarray)
        setattr(owners[place], part, np.array(value, now.dtype) if is_array else type(now)(value))


def freeze(env: Any) -> None:
    """Stops the running statistics of Gymnasium's own wrappers."""
    for wrapper in _wrappers(env):
        if hasattr(type(wrapper), "update_running_mean"):
            wrapper.update_running_mean = False
