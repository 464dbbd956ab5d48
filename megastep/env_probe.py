"""An episode of random actions in an environment of Gymnasium, which tells what cannot be asked of
it. Workers import it, so without PyTorch.
"""

import contextlib
import copy
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from megastep import global_generators
from megastep.sync_envs import TRUE_RETURN, RewardRecorder, numbers_of
from megastep.wrapper_state import wrapper_state

__all__ = ["Probe", "probe"]

#: Steps and seconds of the episode.
MAX_STEPS, MAX_SECONDS = 1000, 5.0


class Probe(NamedTuple):
    """What an episode has told.

    Attributes:
        names: keys of the numbers in its last ``info``, `is_success` first; before them
            `TRUE_RETURN`, if wrappers change rewards.
        generators: kinds of global generators that the environment draws from.
        learnt: paths of what wrappers keep beyond an episode, see `wrapper_state`.
    """

    names: tuple[str, ...] = ()
    generators: tuple[str, ...] = ()
    learnt: tuple[str, ...] = ()


def probe(make: Callable[[], Any], seed: int = 0) -> Probe:
    """Makes an environment, plays an episode of at most `MAX_STEPS` and `MAX_SECONDS`, and closes
    it. Leaves the global generators as they were.

    An error ends the episode: the same one comes in training, which tells of it.
    """
    names, first, last, generators, is_changed = (), {}, {}, (), False
    with global_generators.kept():
        env = make()
        global_generators.seed_all(seed)
        before = global_generators.states()
        with contextlib.suppress(Exception):
            actions = copy.deepcopy(env.action_space)  # which may be that of a class
            actions.seed(seed)
            env.reset(seed=seed)
            first, end = wrapper_state(env), time.monotonic() + MAX_SECONDS
            recorder = RewardRecorder.inside(env)
            for _ in range(MAX_STEPS):
                _, reward, terminated, truncated, info = env.step(actions.sample())
                is_changed |= recorder is not None and bool(recorder.recorded_reward != reward)
                names = sorted(numbers_of(info), key=lambda name: name != "is_success")
                if terminated or truncated or time.monotonic() > end:
                    break
            generators = global_generators.changed_kinds(before)
            global_generators.seed_all(seed)  # so that what a new episode draws is the same
            env.reset(seed=seed)
            last = wrapper_state(env)
        with contextlib.suppress(Exception):
            env.close()
    learnt = (p for p in last if p not in first or not np.array_equal(last[p], first[p]))
    names = [name for name in names if name != TRUE_RETURN]
    names = [TRUE_RETURN, *names] if is_changed else names
    return Probe(tuple(names), generators, tuple(learnt))
