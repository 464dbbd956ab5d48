"""PettingZoo: N copies of any parallel environment of PettingZoo, whose A agents are lanes.

They step on the CPU, one after the other, even if the learner is on a GPU. B = N A lanes.
"""

import copy
import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from pydantic import Field

from megastep.env_probe import play_parallel, probe
from megastep.env_values import masked_actions, problem_of_result
from megastep.envs.on_host.env import VectorizedEnv
from megastep.imports import import_object
from megastep.settings import checked
from megastep.sync_envs import CHECKED_STEPS, BadValue, allowed_actions, close_all
from megastep.types import Tree
from megastep.wrapper_state import WrappedEnvs, wrapper_state

if TYPE_CHECKING:
    import gymnasium

__all__ = ["PettingZoo"]

INSTALL = "pip install 'megastep-flatland[gymnasium]'"


class PettingZoo(VectorizedEnv):
    """Any parallel environment of PettingZoo whose agents have the same spaces.

    Observation:
        As that of :class:`~megastep.envs.gymnasium.Gymnasium`, for each agent. That of an agent
        that is not there is its last one.

    Actions:
        As those of Gymnasium, for each agent, with its mask in its ``info["action_mask"]`` or as
        the part ``action_mask`` of its observation.

    Reward:
        The environment's own. 0 for an agent that is not there.

    Episode end:
        Each agent's own: terminal if the environment terminated it, else truncated. The environment
        is reset when no agent is left. Until then the lane of one that is out, or that the reset
        left out, begins anew in each step and does not learn.

    Metrics:
        None.

    Args:
        n_envs: number of environments, N.
        id: import path of the function that makes one, such as
            ``pettingzoo.sisl.multiwalker_v9:parallel_env``.
        kwargs: arguments of that function.
        wrappers: import paths of PettingZoo's parallel wrappers, ``package.module:Wrapper``, put
            around every environment in this order.
        seed: each environment is reset with a seed of its own, which derives from this one.
        check: as for Gymnasium.
        device: where worlds and actions are. Default: a GPU if there is one.
    """

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=2**16)] = 16,
        *,
        id: str | None = None,
        kwargs: dict[str, Any] | None = None,
        wrappers: tuple[str, ...] = (),
        seed: int = 1,
        check: bool = True,
        device: torch.device | str | None = None,
    ):
        if id is None:
            raise ValueError(
                "env.id is missing; name a function that makes an environment, such as "
                "env.id=pettingzoo.sisl.multiwalker_v9:parallel_env"
            )
        try:
            import gymnasium.vector  # noqa: F401
        except ImportError:
            raise ValueError(f"Gymnasium is not installed: {INSTALL}") from None
        make, functions = import_object(id), [import_object(name) for name in wrappers]
        try:
            vector = ParallelEnvs(make, n_envs, kwargs or {}, check, functions)
        except Exception as error:  # whatever another's constructor raises
            kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
            line = (str(error).splitlines() or [""])[0]
            cause = f" with env.kwargs={kwargs}" if kwargs else ""
            raise ValueError(f"{id} cannot be made{cause}: {kind}{line}") from error
        seeds = np.random.SeedSequence(seed).generate_state(n_envs).tolist()
        super().__init__(id, vector, n_envs, len(vector.agents), seeds, device, check)


class ParallelEnvs(WrappedEnvs):
    """N parallel environments as one of Gymnasium's vector environments, with a row per agent.

    Args:
        make: returns a parallel environment, or a turn-based one that PettingZoo can convert.
        n_envs: number of environments, N.
        kwargs: arguments of ``make``.
        check: checks the form of what the environments return in their first `CHECKED_STEPS`.
        wrappers: put around each, in this order.

    Attributes:
        present: (N, A) bool, agents that act in the next step. An agent is not if the reset left it
            out or its episode has ended, until it is among the environment's agents again.

    Raises:
        ValueError: it is turn-based, or the spaces of two agents differ.
    """

    def __init__(
        self,
        make: Callable,
        n_envs: int,
        kwargs: dict[str, object],
        check: bool = True,
        wrappers: Sequence[Callable] = (),
    ):
        from gymnasium.vector.utils import batch_space, create_empty_array, iterate

        parameters = inspect.signature(make).parameters
        if "render_mode" in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            kwargs = {"render_mode": "rgb_array", **kwargs}

        def make_one() -> Any:
            env = _parallel(make(**kwargs))
            for wrapper in wrappers:
                env = wrapper(env)
            return env

        self.envs = [make_one() for _ in range(n_envs)]
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
        numbers = (masked_actions(self.single_action_space, info) for info in masks.values())
        self.n_masked = min(numbers, default=0)
        self.masks = np.ones((n_lanes, max(0, self.n_masked)), bool)
        shape = n_envs, len(self.agents)
        self.reward, self.present = np.zeros(shape), np.zeros(shape, bool)
        self.terminated, self.truncated = np.zeros(shape, bool), np.zeros(shape, bool)
        self.checks, self.n_checked = check, np.zeros(n_envs, np.int64)
        if wrapper_state(env):
            self.learnt = probe(make_one, play=play_parallel).learnt

    def _common(self, space_of) -> "gymnasium.Space":
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
        return self._observations(), self._news()

    def step(self, actions: Tree) -> tuple:
        from gymnasium.vector.utils import iterate

        rows = iterate(self.actions, actions)
        for e, env in enumerate(self.envs):
            chosen = dict(zip(self.agents, rows))
            if self.present[e].any():
                self._step(e, {agent: chosen[agent] for agent in env.agents})
            else:
                self._begin(e)
        flags = self.terminated.ravel(), self.truncated.ravel()
        return self._observations(), self.reward.ravel(), *flags, self._news()

    def render(self) -> list[np.ndarray]:
        return [env.render() for env in self.envs]

    def close(self) -> None:
        close_all(self.envs)

    def _begin(self, e, seed=None) -> None:
        observed, infos = self._checked(e, "reset", self.envs[e].reset(seed=seed))
        self._observe(e, observed, infos)
        for flags in (self.reward, self.terminated, self.truncated):
            flags[e] = 0
        agents = self.envs[e].agents
        self.present[e] = [agent in agents and agent in observed for agent in self.agents]

    def _step(self, e, actions) -> None:
        env = self.envs[e]
        result = self._checked(e, "step", env.step(actions))
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

    def _checked(self, e, method, result) -> tuple:
        """Returns the result of `reset` or `step`. Raises BadValue if its form is wrong."""
        self._keep_frozen(self.envs[e])
        if not self.checks or self.n_checked[e] >= CHECKED_STEPS:
            return result
        self.n_checked[e] += 1
        problem = problem_of_result(method, result, self.single_observation_space, self.agents)
        if problem:
            raise BadValue.of(problem, f"environment {e}")
        return result

    def _observe(self, e, observed, infos) -> None:
        masks = _masks(observed, infos) if self.n_masked > 0 else {}
        for a, agent in enumerate(self.agents, e * len(self.agents)):
            if agent in observed:
                self.latest[a] = observed[agent]
            if self.n_masked > 0:
                place = f"environment {e}, {agent}"
                self.masks[a] = allowed_actions(masks.get(agent, {}), self.n_masked, place)

    def _news(self) -> dict[str, np.ndarray]:
        news = {"present": self.present.ravel()}
        return {**news, "masks": self.masks.copy()} if self.n_masked > 0 else news

    def _observations(self) -> np.ndarray | dict | tuple:
        from gymnasium.vector.utils import concatenate

        return concatenate(self.single_observation_space, self.latest, self.batch)


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
