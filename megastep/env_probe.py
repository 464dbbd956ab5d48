"""An episode of random actions in an environment of Gymnasium or PettingZoo, which tells what
cannot be asked of it. Workers import it, so without PyTorch.
"""

import contextlib
import copy
import itertools
import time
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from megastep import global_generators
from megastep.env_values import masked_actions
from megastep.sync_envs import TRUE_RETURN, RewardRecorder, numbers_of
from megastep.wrapper_state import wrapper_state

__all__ = ["Probe", "play", "play_parallel", "probe"]

#: Steps and seconds of the episode.
MAX_STEPS, MAX_SECONDS = 1000, 5.0


class Probe(NamedTuple):
    """What an episode has told.

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


def play(env, seed: int) -> Iterator[tuple]:
    """Takes random actions in an environment of Gymnasium. Yields reward, whether the episode is
    over, and info, for each step.
    """
    actions = copy.deepcopy(env.action_space)  # which may be that of a class
    actions.seed(seed)
    while True:
        _, reward, terminated, truncated, info = env.step(actions.sample())
        yield reward, terminated or truncated, info


def play_parallel(env, seed: int) -> Iterator[tuple]:
    """As `play`, in a parallel environment of PettingZoo, without rewards and info."""
    spaces = {agent: copy.deepcopy(env.action_space(agent)) for agent in env.possible_agents}
    for space in spaces.values():
        space.seed(seed)
    while True:
        _, _, *flags, _ = env.step({agent: spaces[agent].sample() for agent in env.agents})
        ended: Mapping[str, bool] = {a: any(f.get(a) for f in flags) for a in set().union(*flags)}
        yield 0.0, not env.agents or all(ended.values()) or ended.get("__all__", False), {}


def probe(make: Callable, seed: int = 0, play: Callable = play) -> Probe:
    """Makes an environment, plays an episode of at most `MAX_STEPS` and `MAX_SECONDS`, and closes
    it. Leaves the global generators as they were.

    An error ends the episode: the same one comes in training, which tells of it.

    Args:
        play: takes random actions, as `play` does.
    """
    names, first, last, is_changed, n_masked = (), {}, {}, False, 0
    with global_generators.kept():
        env = make()
        global_generators.seed_all(seed)
        before = global_generators.states()
        with contextlib.suppress(Exception):
            n_masked = masked_actions(env.action_space, env.reset(seed=seed)[1])
            first, end = wrapper_state(env), time.monotonic() + MAX_SECONDS
            recorder = RewardRecorder.inside(env)
            for reward, is_over, info in itertools.islice(play(env, seed), MAX_STEPS):
                is_changed |= recorder is not None and bool(recorder.recorded_reward != reward)
                names = sorted(numbers_of(info), key=lambda name: name != "is_success")
                if is_over or time.monotonic() > end:
                    break
        generators = global_generators.changed_kinds(before)
        with contextlib.suppress(Exception):
            global_generators.seed_all(seed)  # so that what a new episode draws is the same
            env.reset(seed=seed)
            last = wrapper_state(env)
        with contextlib.suppress(Exception):
            env.close()
    learnt = (p for p in last if p not in first or not np.array_equal(last[p], first[p]))
    names = [name for name in names if name != TRUE_RETURN]
    names = [TRUE_RETURN, *names] if is_changed else names
    return Probe(tuple(names), generators, tuple(learnt), n_masked)
