"""An episode of random actions in an environment of Gymnasium, which finds what cannot be
asked of it. Workers import it, so without PyTorch.
"""

import contextlib
import copy
import numbers
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from megastep.global_generators import KINDS, GlobalGenerators, kept
from megastep.hosting.values import masked_actions
from megastep.hosting.wrapper_state import wrapper_state
from megastep.types import Tree

__all__ = ["TRUE_RETURN", "Probe", "RewardRecorder", "numbers_of", "probe"]

#: Name of the sum of an episode's rewards before wrappers change them.
TRUE_RETURN = "true_return"
#: Steps and seconds of the episode.
MAX_STEPS, MAX_SECONDS = 1000, 5.0


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
