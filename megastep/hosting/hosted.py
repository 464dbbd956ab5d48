"""Environments of Gymnasium that step one after the other in one process. Workers import this file,
so without PyTorch.
"""

import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from megastep.global_generators import KINDS, GlobalGenerators
from megastep.hosting.env_error import BadValue, EnvError
from megastep.hosting.probe import TRUE_RETURN, Probe, RewardRecorder, numbers_of
from megastep.hosting.values import CHECKED_STEPS, allowed_actions, problem
from megastep.hosting.wrapper_state import freeze, load_wrapper_state, wrapper_state
from megastep.types import Space, Tree

__all__ = ["Hosted", "HostedEnvs", "make_env"]


def make_env(spec: Any, wrappers: Sequence[Callable], settings: dict) -> gymnasium.Env:
    """Returns an environment of Gymnasium by its specification, inside wrappers."""
    env = gymnasium.make(spec, **settings)
    env = RewardRecorder(env) if wrappers else env
    for wrapper in wrappers:
        env = wrapper(env)
    return env


class Hosted:
    """Environments in this process, of Gymnasium or PettingZoo.

    Attributes:
        envs: the environments.
        first: number of the first in messages.
        found: what a probe has found about them.
        n_to_check: steps in which the form of what they return is still checked.
    """

    HAS_PLAIN_STATE = True  # see :mod:`megastep.env_state`
    max_episode_steps: int | None = None
    first = 0
    envs: list[Any]
    metadata: dict[str, Any]
    render_mode: str | None
    single_observation_space: Space
    single_action_space: Space

    def __init__(self, found: Probe | None, check: bool):
        self.found, self.n_to_check = found or Probe(), CHECKED_STEPS if check else 0
        self.frozen: Tree = None  # a state of the wrappers that does not change

    def wrapper_state(self) -> Tree:
        """Returns what the wrappers of the first environment have learnt, by path."""
        return wrapper_state(self.envs[0], self.found.learnt) if self.found.learnt else {}

    def load_wrapper_state(self, state: Tree, is_frozen: bool) -> None:
        """Gives the wrappers of all environments what others have learnt, which stays as it is if
        it `is_frozen`. Raises ValueError if they are not in such wrappers.
        """
        self.frozen = state if is_frozen else None
        for env in self.envs:
            load_wrapper_state(env, state)
            if is_frozen:
                freeze(env)

    def start_rendering(self) -> str | None:
        """Sets the render mode to rgb_array, if there is that and no other was chosen, and returns
        it. Not before the first frame: LunarLander then steps at a third of the speed.
        """
        if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
            os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # else pygame complains of no display
        if self.render_mode is None and "rgb_array" in self.metadata.get("render_modes", ()):
            for env in self.envs:
                env.unwrapped.render_mode = "rgb_array"
            self.render_mode = "rgb_array"
        return self.render_mode

    def render(self) -> list[np.ndarray]:
        return [env.render() for env in self.envs]

    def close(self) -> None:
        """Closes the environments. Raises the first error once all are closed."""
        errors = []
        for e, env in enumerate(self.envs):
            try:
                env.close()
            except Exception as error:
                errors.append(EnvError.of(error, self._name(e)))
        if errors:
            raise errors[0]

    def _checked(self, e, method, result, agents=None) -> Any:
        """Returns what environment e returned. Raises BadValue if its form is wrong."""
        space = self.single_observation_space
        if self.n_to_check and (clause := problem(method, result, space, agents)):
            raise BadValue.of(clause, self._name(e))
        return result

    def _name(self, e) -> str:
        return f"environment {self.first + e}"


class HostedEnvs(Hosted):
    """N environments of Gymnasium, each with global generators of its own. The step after an
    episode's end resets it. Infos have

    - `numbers`: (N, len(found.names)), of an environment's last episode, nan where there is none
    - `action_mask`: (N, found.n_masked) bool

    Args:
        make: makes one environment.
        n_envs: number of environments, N.
        first: number of the first in messages and for its seeds.
        found: what a probe has found.
        seed: of the global generators.
        check: checks the form of what they return in the first `CHECKED_STEPS`.
    """

    def __init__(
        self,
        make: Callable[[], gymnasium.Env],
        n_envs: int,
        first: int = 0,
        found: Probe | None = None,
        seed: int = 0,
        check: bool = True,
    ):
        super().__init__(found, check)
        self.first, self.envs, self.generators = first, [], []
        for number in range(first, first + n_envs):
            generators = GlobalGenerators([seed, number])
            with generators.installed(KINDS):
                self.envs.append(make())
            generators.drop({*KINDS} - {*self.found.generators})  # checkpoints do not hold them
            self.generators.append(generators)
        env = self.envs[0]
        self.metadata, self.render_mode = env.metadata, env.render_mode
        self.single_observation_space = env.observation_space
        self.single_action_space = env.action_space
        self.actions = batch_space(env.action_space, n_envs)
        self.latest: list[Tree] = [None] * n_envs
        self.batch = create_empty_array(env.observation_space, n_envs)
        self.rewards, self.ended = np.zeros(n_envs), np.zeros(n_envs, bool)
        self.terminated, self.truncated = np.zeros(n_envs, bool), np.zeros(n_envs, bool)
        self.numbers = np.zeros((n_envs, len(self.found.names)))
        self.masks = np.ones((n_envs, max(0, self.found.n_masked)), bool)

    def reset(self, *, seed: Sequence[int] | None = None) -> tuple[Tree, dict]:
        """Resets every environment. Returns (observations, infos)."""
        self.ended[:] = True
        obs, *_, infos = self._advance([None] * len(self.envs), seed)
        return obs, infos

    def step(self, actions: Tree) -> tuple:
        """Takes one step. Returns (observations, rewards, terminated, truncated, infos), which are
        valid until the next call.
        """
        return self._advance(iterate(self.actions, actions))

    def _advance(self, actions, seeds=None) -> tuple:
        """Resets environments whose episodes have ended, and steps the others."""
        latest, rewards = self.latest, self.rewards
        terminated, truncated = flags = self.terminated, self.truncated
        is_watched = bool(self.found.generators or self.frozen or self.n_to_check)
        n_masked, e = self.masks.shape[1], 0
        try:
            for e, (action, begins) in enumerate(zip(actions, self.ended.tolist())):
                if begins:
                    settings = {"seed": int(seeds[e])} if seeds else {}
                    latest[e], info = self._call(e, "reset", **settings)
                    rewards[e] = terminated[e] = truncated[e] = 0
                else:
                    env = self.envs[e]
                    result = self._call(e, "step", action) if is_watched else env.step(action)
                    latest[e], rewards[e], terminated[e], truncated[e], info = result
                    if self.found.names and (terminated[e] or truncated[e]):
                        self._keep_numbers(e, info)
                if n_masked:
                    self.masks[e] = allowed_actions(info, n_masked, self._name(e))
        except (EnvError, MemoryError):
            raise
        except Exception as error:
            raise EnvError.of(error, self._name(e)) from error
        self.n_to_check = max(0, self.n_to_check - 1)
        np.logical_or(*flags, out=self.ended)
        obs = concatenate(self.single_observation_space, latest, self.batch)
        return obs, rewards, *flags, {"numbers": self.numbers, "action_mask": self.masks}

    def _call(self, e, method, *arguments, **settings) -> tuple:
        """Calls an environment, which draws from global generators of its own."""
        with self.generators[e].installed(self.found.generators):
            result = getattr(self.envs[e], method)(*arguments, **settings)
        if self.frozen:
            load_wrapper_state(self.envs[e], self.frozen)
        return self._checked(e, method, result)

    def _keep_numbers(self, e, info) -> None:
        numbers = numbers_of(info)
        if recorder := RewardRecorder.inside(self.envs[e]):
            numbers[TRUE_RETURN] = recorder.recorded_return
        self.numbers[e] = [numbers.get(name, np.nan) for name in self.found.names]
