"""Environments of Gymnasium and PettingZoo in this process, or a worker's: without PyTorch."""

import copy
import importlib
import inspect
import itertools
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from megastep.global_generators import KINDS, GlobalGenerators
from megastep.hosting.env_error import EnvError
from megastep.hosting.probe import (
    TRUE_RETURN,
    Probe,
    RewardRecorder,
    allowed_actions,
    freeze,
    load_wrapper_state,
    masked_actions,
    numbers_of,
    wrapper_state,
)
from megastep.types import Space, Tree


def make_env(spec: Any, wrappers: Sequence[Callable], settings: dict) -> gymnasium.Env:
    """Returns an environment of Gymnasium by its specification, inside wrappers."""
    env = gymnasium.make(spec, **settings)
    env = RewardRecorder(env) if wrappers else env
    for wrapper in wrappers:
        env = wrapper(env)
    return env


class Hosted:
    """N environments of A agents in this process, B = N A lanes. The step after all agents of one
    have ended resets it. Arrays are valid until the next call. A subclass has `_begin` and `_step`.
    """

    HAS_PLAIN_STATE = True  # see :mod:`megastep.env_state`
    max_episode_steps: int | None = None
    _begin: Callable  # (e, settings) and (e, actions) -> None, of subclasses
    _step: Callable

    def __init__(
        self,
        envs: list[Any],
        spaces: tuple[Space, Space],
        found: Probe,
        n_agents: int = 1,
        first: int = 0,
    ):
        self.envs, self.found, self.n_agents, self.first = envs, found, n_agents, first
        self.metadata, self.render_mode = envs[0].metadata, getattr(envs[0], "render_mode", None)
        self.single_observation_space, self.single_action_space = spaces
        n = len(envs) * n_agents
        self.actions = batch_space(self.single_action_space, n)
        self.batch = create_empty_array(self.single_observation_space, n)
        self.latest: list[Tree] = [None] * n  # observations
        self.rewards = np.zeros(n)
        self.terminated, self.truncated = np.zeros(n, bool), np.zeros(n, bool)
        self.masks = np.ones((n, max(0, found.n_masked)), bool)
        self.ended = np.ones(len(envs), bool)
        self.infos: dict[str, Any] = {"action_mask": self.masks}
        self.frozen: Tree = None  # a state of the wrappers that does not change

    def reset(self, *, seed: Sequence[int] | None = None) -> tuple:
        """Resets every environment. Returns what a step returns."""
        self.ended[:] = True
        return self._advance(itertools.repeat(()), seed)

    def step(self, actions: Tree) -> tuple:
        """Takes one step. Returns (observations, rewards, terminated, truncated, infos)."""
        return self._advance(zip(*[iter(iterate(self.actions, actions))] * self.n_agents))

    def _advance(self, actions, seeds=None) -> tuple:
        """Resets environments whose episodes have ended, and steps the others."""
        e = 0
        try:
            for e, (begins, chosen) in enumerate(zip(self.ended.tolist(), actions)):
                if begins:
                    self._begin(e, {"seed": int(seeds[e])} if seeds else {})
                else:
                    self._step(e, chosen)
        except (EnvError, MemoryError):
            raise
        except Exception as error:
            raise EnvError.of(error, self._name(e)) from error
        obs = concatenate(self.single_observation_space, self.latest, self.batch)
        return obs, self.rewards, self.terminated, self.truncated, self.infos

    def _name(self, e) -> str:
        return f"environment {self.first + e}"

    def wrapper_state(self) -> Tree:
        """Returns the running statistics in the wrappers of the first environment, by path."""
        return wrapper_state(self.envs[0])

    def load_wrapper_state(self, state: Tree, is_frozen: bool) -> None:
        """Gives all wrappers the statistics of others, to stay if `is_frozen`. ValueError."""
        self.frozen = state if is_frozen else None
        for env in self.envs:
            load_wrapper_state(env, state)
            if is_frozen:
                freeze(env)

    def start_rendering(self) -> str | None:
        """Sets and returns the render mode, at the first frame: it slows LunarLander's steps."""
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


class HostedEnvs(Hosted):
    """N environments of Gymnasium, each with global generators of its own, of a seed. Infos also
    have `numbers`, (N, len(found.names)) of an environment's last episode, nan where there is none.
    """

    def __init__(
        self,
        make: Callable[[], gymnasium.Env],
        n_envs: int,
        first: int = 0,
        found: Probe | None = None,
        seed: int = 0,
    ):
        envs, self.generators, found = [], [], found or Probe()
        for number in range(first, first + n_envs):
            generators = GlobalGenerators([seed, number])
            with generators.installed(KINDS):
                envs.append(make())
            generators.drop({*KINDS} - {*found.generators})  # checkpoints do not hold them
            self.generators.append(generators)
        spaces = envs[0].observation_space, envs[0].action_space
        super().__init__(envs, spaces, found, first=first)
        self.numbers = self.infos["numbers"] = np.zeros((n_envs, len(found.names)))

    def _begin(self, e, settings) -> None:
        self.latest[e], info = self._call(e, "reset", **settings)
        self.rewards[e] = self.terminated[e] = self.truncated[e] = self.ended[e] = 0
        if self.found.n_masked > 0:
            self.masks[e] = allowed_actions(info, self.found.n_masked, self._name(e))

    def _step(self, e, chosen) -> None:
        found, env = self.found, self.envs[e]
        is_watched = found.generators or self.frozen
        result = self._call(e, "step", *chosen) if is_watched else env.step(*chosen)
        self.latest[e], self.rewards[e], terminated, truncated, info = result
        self.terminated[e], self.truncated[e] = terminated, truncated
        self.ended[e] = is_over = terminated or truncated
        if is_over and found.names:
            numbers = numbers_of(info)
            if recorder := RewardRecorder.inside(env):
                numbers[TRUE_RETURN] = recorder.recorded_return
            self.numbers[e] = [numbers.get(name, np.nan) for name in found.names]
        if found.n_masked > 0:
            self.masks[e] = allowed_actions(info, found.n_masked, self._name(e))

    def _call(self, e, method, *arguments, **settings) -> tuple:
        """Calls an environment, which draws from global generators of its own."""
        with self.generators[e].installed(self.found.generators):
            result = getattr(self.envs[e], method)(*arguments, **settings)
        if self.frozen:
            load_wrapper_state(self.envs[e], self.frozen)
        return result


class ParallelEnvs(Hosted):
    """N parallel environments of PettingZoo. `present`, (B,) bool: agents of the next step."""

    def __init__(
        self, make: Callable, n_envs: int, kwargs: dict[str, Any], wrappers: Sequence[Callable] = ()
    ):
        parameters = inspect.signature(make).parameters
        if "render_mode" in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            kwargs = {"render_mode": "rgb_array", **kwargs}
        envs = []
        for _ in range(n_envs):
            env = _parallel(make(**kwargs))
            for wrapper in wrappers:
                env = wrapper(env)
            envs.append(env)
        env = envs[0]
        self.agents = list(env.possible_agents)
        first = env.reset()
        spaces = self._common(env.observation_space), self._common(env.action_space)
        masks = _masks(*first) if isinstance(first, tuple) and len(first) == 2 else {}
        sizes = [masked_actions(spaces[1], one) for one in masks.values()]
        found = Probe(n_masked=min(sizes, default=0))
        super().__init__(envs, spaces, found, len(self.agents))
        self.render_mode = kwargs.get("render_mode")
        lanes = batch_space(spaces[0], len(self.latest))
        self.latest = [*iterate(lanes, copy.deepcopy(self.batch))]
        if isinstance(first, tuple) and isinstance(first[0], Mapping) and first[0]:
            # of agents that join later: zeros may be outside of the space
            self.latest = [copy.deepcopy(next(iter(first[0].values())))] * len(self.latest)
        self.present = self.infos["present"] = np.zeros(len(self.latest), bool)

    def _common(self, space_of) -> gymnasium.Space:
        first, *others = self.agents
        for agent in others:
            if space_of(agent) != space_of(first):
                raise ValueError(
                    f"the spaces of {first} and {agent} differ, but one policy acts for all agents"
                )
        return space_of(first)

    def _lanes(self, e) -> Iterator[tuple[int, Any]]:
        """Yields the lane and the name of each agent of an environment."""
        return enumerate(self.agents, e * self.n_agents)

    def _begin(self, e, settings) -> None:
        env = self.envs[e]
        observed, infos = env.reset(**settings)
        self._observe(e, observed, infos)
        for lane, agent in self._lanes(e):
            self.rewards[lane] = self.terminated[lane] = self.truncated[lane] = 0
            self.present[lane] = agent in env.agents and agent in observed
        self.ended[e] = False

    def _step(self, e, chosen) -> None:
        env, actions = self.envs[e], dict(zip(self.agents, chosen))
        observed, rewards, terminated, truncated, infos = env.step(
            {agent: actions[agent] for agent in env.agents}
        )
        self._observe(e, observed, infos)
        self.ended[e] = True
        for lane, agent in self._lanes(e):
            was_present = self.present[lane]
            ends, cut = (
                bool(flags.get(agent, False) or flags.get("__all__", False))
                for flags in (terminated, truncated)
            )
            is_here = agent in env.agents and agent in observed and not (ends or cut)
            self.rewards[lane] = rewards.get(agent, 0.0) if was_present else 0.0
            self.terminated[lane] = was_present and ends
            self.truncated[lane] = was_present and not ends and not is_here
            self.present[lane] = is_here
            self.ended[e] &= not is_here

    def _observe(self, e, observed, infos) -> None:
        n_masked = self.masks.shape[1]
        masks = _masks(observed, infos) if n_masked else {}
        for lane, agent in self._lanes(e):
            if agent in observed:
                self.latest[lane] = observed[agent]
            if n_masked:
                place = f"environment {e}, {agent}"
                self.masks[lane] = allowed_actions(masks.get(agent, {}), n_masked, place)


def _masks(observed, infos) -> dict[str, Mapping]:
    """Returns what has the action mask of each agent that has one: its info or its observation."""
    found = {}
    for part in (observed, infos):
        for agent, one in part.items() if isinstance(part, Mapping) else ():
            if isinstance(one, Mapping) and "action_mask" in one:
                found[agent] = one
    return found


def _parallel(env) -> Any:
    """Returns an environment in which agents act together."""
    if not hasattr(env, "agent_iter"):
        return env
    if getattr(env, "metadata", {}).get("is_parallelizable"):
        conversions = importlib.import_module("pettingzoo.utils.conversions")
        return conversions.aec_to_parallel(env)
    raise ValueError(
        "it is turn-based, and agents have to act together; name the function that makes its "
        "parallel form, such as env.id=package.module:parallel_env, or one whose metadata has "
        "is_parallelizable"
    )
