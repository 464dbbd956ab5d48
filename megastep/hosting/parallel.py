"""N parallel environments of PettingZoo, whose agents are lanes."""

import copy
import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from megastep.hosting.hosted import Hosted
from megastep.hosting.probe import Probe
from megastep.hosting.values import allowed_actions, masked_actions
from megastep.types import Tree

__all__ = ["ParallelEnvs"]


class ParallelEnvs(Hosted):
    """N parallel environments as one of Gymnasium's vector environments, with a row per agent.

    Args:
        make: returns a parallel environment, or a turn-based one that PettingZoo can convert.
        n_envs: number of environments, N.
        kwargs: arguments of ``make``.
        check: checks the form of what the environments return in their first steps.
        wrappers: put around each, in this order.

    Attributes:
        present: (N, A) bool, agents that act in the next step. An agent is not if the reset left it
            out or its episode has ended, until it is among the environment's agents again.
    """

    def __init__(
        self,
        make: Callable,
        n_envs: int,
        kwargs: dict[str, Any],
        check: bool = True,
        wrappers: Sequence[Callable] = (),
    ):
        super().__init__(None, check)
        parameters = inspect.signature(make).parameters
        if "render_mode" in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            kwargs = {"render_mode": "rgb_array", **kwargs}

        self.envs = []
        for _ in range(n_envs):
            env = _parallel(make(**kwargs))
            for wrapper in wrappers:
                env = wrapper(env)
            self.envs.append(env)
        self.render_mode, env = kwargs.get("render_mode"), self.envs[0]
        self.agents, self.metadata = list(env.possible_agents), env.metadata
        first = env.reset()
        self.single_observation_space = self._common(env.observation_space)
        self.single_action_space = self._common(env.action_space)
        n_lanes = n_envs * len(self.agents)
        self.actions = batch_space(self.single_action_space, n_lanes)
        self.batch = create_empty_array(self.single_observation_space, n_lanes)
        lanes = batch_space(self.single_observation_space, n_lanes)
        self.latest = [*iterate(lanes, copy.deepcopy(self.batch))]  # observations
        masks = _masks(*first) if isinstance(first, tuple) and len(first) == 2 else {}
        sizes = [masked_actions(self.single_action_space, one) for one in masks.values()]
        self.found = Probe(n_masked=min(sizes, default=0))
        self.masks = np.ones((n_lanes, max(0, self.found.n_masked)), bool)
        shape = n_envs, len(self.agents)
        self.reward, self.present = np.zeros(shape), np.zeros(shape, bool)
        self.terminated, self.truncated = np.zeros(shape, bool), np.zeros(shape, bool)

    def _common(self, space_of) -> gymnasium.Space:
        first, *others = self.agents
        for agent in others:
            if space_of(agent) != space_of(first):
                raise ValueError(
                    f"the spaces of {first} and {agent} differ, but one policy acts for all agents"
                )
        return space_of(first)

    def reset(self, *, seed: list[int] | None = None) -> tuple[Tree, dict]:
        for e in range(len(self.envs)):
            self._begin(e, seed and seed[e])
        obs, *_, infos = self._results()
        return obs, infos

    def step(self, actions: Tree) -> tuple:
        rows = iterate(self.actions, actions)
        for e, env in enumerate(self.envs):
            chosen = dict(zip(self.agents, rows))
            if self.present[e].any():
                self._step(e, {agent: chosen[agent] for agent in env.agents})
            else:
                self._begin(e)
        return self._results()

    def _begin(self, e, seed=None) -> None:
        env = self.envs[e]
        observed, infos = self._checked(e, "reset", env.reset(seed=seed), self.agents)
        self._observe(e, observed, infos)
        self.reward[e] = self.terminated[e] = self.truncated[e] = 0
        self.present[e] = [agent in env.agents and agent in observed for agent in self.agents]

    def _step(self, e, actions) -> None:
        env = self.envs[e]
        result = self._checked(e, "step", env.step(actions), self.agents)
        observed, rewards, terminated, truncated, infos = result
        self._observe(e, observed, infos)
        for a, agent in enumerate(self.agents):
            was_present = self.present[e, a]
            ends, cut = (
                bool(flags.get(agent, False) or flags.get("__all__", False))
                for flags in (terminated, truncated)
            )
            is_here = agent in env.agents and agent in observed and not (ends or cut)
            self.reward[e, a] = rewards.get(agent, 0.0) if was_present else 0.0
            self.terminated[e, a] = was_present and ends
            self.truncated[e, a] = was_present and not ends and not is_here
            self.present[e, a] = is_here

    def _observe(self, e, observed, infos) -> None:
        n_masked = self.masks.shape[1]
        masks = _masks(observed, infos) if n_masked else {}
        for a, agent in enumerate(self.agents, e * len(self.agents)):
            if agent in observed:
                self.latest[a] = observed[agent]
            if n_masked:
                place = f"environment {e}, {agent}"
                self.masks[a] = allowed_actions(masks.get(agent, {}), n_masked, place)

    def _results(self) -> tuple:
        self.n_to_check = max(0, self.n_to_check - 1)
        obs = concatenate(self.single_observation_space, self.latest, self.batch)
        flags = self.terminated.ravel(), self.truncated.ravel()
        infos = {"present": self.present.ravel(), "action_mask": self.masks}
        return obs, self.reward.ravel(), *flags, infos


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
