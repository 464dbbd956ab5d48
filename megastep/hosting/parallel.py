"""N parallel environments of PettingZoo, whose agents are lanes."""

import copy
import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space, iterate

from megastep.hosting.hosted import Hosted
from megastep.hosting.probe import Probe
from megastep.hosting.values import allowed_actions, masked_actions

__all__ = ["ParallelEnvs"]


class ParallelEnvs(Hosted):
    """N parallel environments of PettingZoo, with a row per agent, or turn-based ones that it can
    convert.

    Attributes:
        present: (B,) bool, agents that act in the next step, also in infos. An agent is not if the
            reset left it out or its episode has ended, until it is among the environment's agents
            again.
    """

    def __init__(
        self,
        make: Callable,
        n_envs: int,
        kwargs: dict[str, Any],
        check: bool = True,
        wrappers: Sequence[Callable] = (),
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
        super().__init__(envs, spaces, found, check, len(self.agents))
        self.render_mode = kwargs.get("render_mode")
        lanes = batch_space(spaces[0], len(self.latest))
        self.latest = [*iterate(lanes, copy.deepcopy(self.batch))]
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
        observed, infos = self._checked(e, "reset", env.reset(**settings), self.agents)
        self._observe(e, observed, infos)
        for lane, agent in self._lanes(e):
            self.rewards[lane] = self.terminated[lane] = self.truncated[lane] = 0
            self.present[lane] = agent in env.agents and agent in observed
        self.ended[e] = False

    def _step(self, e, chosen) -> None:
        env, actions = self.envs[e], dict(zip(self.agents, chosen))
        result = env.step({agent: actions[agent] for agent in env.agents})
        observed, rewards, terminated, truncated, infos = self._checked(
            e, "step", result, self.agents
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
