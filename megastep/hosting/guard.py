"""Guards an environment of somebody else, and steps several with Gymnasium's `SyncVectorEnv`.
Workers import it, so without PyTorch.

An error of an environment is an EnvError, which has its traceback as text, or begins that
environment anew.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from megastep.global_generators import KINDS, GlobalGenerators
from megastep.hosting.env_error import BadValue, EnvError
from megastep.hosting.probe import TRUE_RETURN, Probe, RewardRecorder, numbers_of
from megastep.hosting.values import CHECKED_STEPS, allowed_actions, problem
from megastep.hosting.wrapper_state import give_state, load_wrapper_state, wrapper_state
from megastep.types import Tree

__all__ = ["GuardedEnv", "HostedEnvs", "close_all", "make_env", "start_rendering"]

NO_NEWS: dict[str, Any] = {}


def make_env(spec: Any, wrappers: Sequence[Callable], settings: dict) -> gymnasium.Env:
    """Returns an environment of Gymnasium by its specification, inside wrappers."""
    env = gymnasium.make(spec, **settings)
    env = RewardRecorder(env) if wrappers else env
    for wrapper in wrappers:
        env = wrapper(env)
    return env


class GuardedEnv(gymnasium.Wrapper):
    """An environment that may fail, which finds global generators of its own. Its ``info`` has

    - `numbers`: at the end of an episode those of `found.names`, nan where there is none
    - `action_mask`: (n,) bool, if there are masks
    - `failure`: the EnvError after which the environment was made anew, and `restarts`, how often

    Args:
        make: makes the environment.
        number: its number in messages and for its seeds.
        seed: of the global generators.
        found: what a probe has found.
        restart_failed: how often it is made anew after an error. Its episode ends as truncated at
            its last observation, and the next one gets a seed of its own.
        check: checks the form of what it returns in its first `CHECKED_STEPS`.
    """

    HAS_PLAIN_STATE = True  # see :mod:`megastep.env_state`

    def __init__(
        self,
        make: Callable[[], gymnasium.Env],
        number: int = 0,
        seed: int = 0,
        found: Probe | None = None,
        restart_failed: int = 0,
        check: bool = True,
    ):
        self.make, self.place, self.found = make, f"environment {number}", found or Probe()
        self.generators = GlobalGenerators([seed, number])
        with self.generators.installed(KINDS):
            super().__init__(make())
        self.generators.drop({*KINDS} - {*self.found.generators})  # checkpoints do not hold them
        self.recorder = RewardRecorder.inside(self.env)
        self.n_to_check = CHECKED_STEPS if check else 0
        self.restart_failed, self.n_restarts, self.is_new = restart_failed, 0, False
        self.first_seed, self.true_return = 0, 0.0
        self.is_watched, self.has_masks = True, self.found.n_masked > 0
        self.last_obs: Tree = None
        self.frozen: Tree = None  # a state of its wrappers that does not change

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Tree, dict]:
        failures = []
        self.first_seed = self.first_seed if seed is None else int(seed)
        while True:
            if self.is_new:  # draws that no other environment has
                numbers = [self.first_seed, self.n_restarts]
                seed = int(np.random.SeedSequence(numbers).generate_state(1)[0])
            try:
                obs, info = self._call("reset", **{} if seed is None else {"seed": seed})
                news = self._news(info, failures)
                break
            except Exception as error:
                failures.append(self._begin_anew(error))
        self.last_obs, self.is_new, self.true_return = obs, False, 0.0
        return obs, news

    def step(self, action: Tree) -> tuple[Tree, Any, bool, bool, dict]:
        try:
            result = self._call("step", action) if self.is_watched else self.env.step(action)
            obs, reward, terminated, truncated, info = result
            if self.recorder is not None:
                self.true_return += float(self.recorder.recorded_reward)
            is_over = terminated or truncated
            news = self._news(info, (), is_over) if is_over or self.has_masks else NO_NEWS
        except Exception as error:
            failures = [self._begin_anew(error)]
            return self.last_obs, 0.0, False, True, self._news({}, failures, True)
        self.last_obs = obs
        return obs, reward, terminated, truncated, news

    def close(self) -> None:
        try:
            super().close()
        except Exception as error:
            raise EnvError.of(error, self.place) from error

    def _call(self, method, *arguments, **more) -> tuple:
        call = getattr(self.env, method)
        if self.found.generators:
            with self.generators.installed(self.found.generators):
                result = call(*arguments, **more)
        else:
            result = call(*arguments, **more)
        if self.frozen:
            load_wrapper_state(self.env, self.frozen)
        if self.n_to_check > 0:
            self.n_to_check -= 1
            if clause := problem(method, result, self.env.observation_space):
                raise BadValue.of(clause, self.place)
        self.is_watched = bool(self.found.generators or self.frozen or self.n_to_check > 0)
        return result

    def _news(self, info, failures, is_over=False) -> dict[str, Any]:
        news = {}
        if is_over and self.found.names:
            numbers = numbers_of(info)
            if self.recorder is not None:
                numbers[TRUE_RETURN] = self.true_return
            news["numbers"] = np.array([numbers.get(name, np.nan) for name in self.found.names])
        if self.found.n_masked > 0:
            news["action_mask"] = allowed_actions(info, self.found.n_masked, self.place)
        if failures:
            news |= {"failure": failures[0], "restarts": len(failures)}
        return news

    def _begin_anew(self, error) -> EnvError:
        """Makes the environment again after an error. Raises EnvError if it had all its
        restarts.
        """
        if isinstance(error, (BadValue, MemoryError)):
            raise error
        failure = EnvError.of(error, self.place)
        if self.n_restarts >= self.restart_failed:
            raise failure from error
        self.n_restarts, self.is_new = self.n_restarts + 1, True
        learnt = wrapper_state(self.env, self.found.learnt) if self.found.learnt else {}
        with contextlib.suppress(Exception):
            self.env.close()
        try:
            with self.generators.installed(self.found.generators):
                self.env = self.make()
            load_wrapper_state(self.env, learnt)
        except Exception as again:
            raise EnvError.of(again, self.place) from again
        self.recorder = RewardRecorder.inside(self.env)
        return failure


class HostedEnvs(gymnasium.vector.SyncVectorEnv):
    """Guarded environments that step one after the other. The step after an episode's end resets
    it.

    Args:
        make: makes one environment.
        n_envs: number of environments, N.
        first: number of the first.
        found: what a probe has found.
        settings: others of `GuardedEnv`.
    """

    HAS_PLAIN_STATE = True
    max_episode_steps: int | None = None
    envs: list[Any]  # GuardedEnvs

    def __init__(
        self,
        make: Callable[[], gymnasium.Env],
        n_envs: int,
        first: int = 0,
        found: Probe | None = None,
        **settings: Any,
    ):
        self.found, self.restart_failed = found or Probe(), settings.get("restart_failed", 0)
        guarded = partial(GuardedEnv, make, found=self.found, **settings)
        super().__init__([partial(guarded, first + i) for i in range(n_envs)], copy=False)

    def wrapper_state(self) -> Tree:
        """Returns what the wrappers of the first environment have learnt, by path."""
        learnt = self.found.learnt
        return wrapper_state(self.envs[0].env, learnt) if learnt else {}

    def load_wrapper_state(self, state: Tree, is_frozen: bool) -> None:
        """Gives the wrappers of all environments what others have learnt.

        Args:
            is_frozen: it stays as it is from now on.

        Raises:
            ValueError: the environments are not in such wrappers.
        """
        for guard in self.envs:
            guard.frozen, guard.is_watched = give_state(guard.env, state, is_frozen), True

    def close_extras(self, **kwargs: Any) -> None:
        close_all(self.envs)


def close_all(envs: Sequence[Any]) -> None:
    """Closes environments. Raises the first error once all are closed, a TimeoutError at once."""
    errors = []
    for env in envs:
        try:
            env.close()
        except TimeoutError:
            raise
        except Exception as error:
            errors.append(error)
    if errors:
        raise errors[0]


def start_rendering(vector: Any) -> None:
    """Sets the render mode of environments to rgb_array, if they have it and no other was chosen.

    Called before the first frame and not earlier: with a render mode, LunarLander simulates the
    particles of its exhaust and steps at a third of the speed.
    """
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # else pygame complains of no display
    if vector.render_mode is None and "rgb_array" in vector.metadata.get("render_modes", ()):
        for env in getattr(vector, "envs", ()):
            env.unwrapped.render_mode = "rgb_array"
        vector.render_mode = "rgb_array"
