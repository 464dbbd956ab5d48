"""PettingZoo: N copies of any parallel environment of PettingZoo, whose A agents are lanes.

They step on the CPU, one after the other, even if the learner is on a GPU. B = N A lanes.
"""

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from pydantic import Field

from megastep.envs.on_host.env import VectorizedEnv
from megastep.imports import import_object
from megastep.settings import checked

if TYPE_CHECKING:
    import gymnasium

__all__ = ["PettingZoo"]

INSTALL = "pip install 'megastep-flatland[gymnasium]'"


class PettingZoo(VectorizedEnv):
    """Any parallel environment of PettingZoo whose agents have the same spaces.

    Observation:
        As that of :class:`~megastep.envs.gymnasium.Gymnasium`, for each agent. An agent that is out
        before the others keeps its last observation.

    Actions:
        As those of Gymnasium, for each agent.

    Reward:
        The environment's own. 0 for an agent that is out.

    Episode end:
        When all agents are out: terminal for those that the environment terminated, truncated for
        the others.

    Metrics:
        None.

    Args:
        n_envs: number of environments, N.
        id: import path of the function that makes one, such as
            ``pettingzoo.sisl.multiwalker_v9:parallel_env``.
        kwargs: arguments of that function.
        seed: each environment is reset with a seed of its own, which derives from this one.
        device: where worlds and actions are. Default: a GPU if there is one.
    """

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=2**16)] = 16,
        *,
        id: str | None = None,
        kwargs: dict[str, Any] | None = None,
        seed: int = 1,
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
        make = import_object(id)
        try:
            vector = ParallelEnvs(make, n_envs, kwargs or {})
        except Exception as error:  # whatever another's constructor raises
            kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
            line = (str(error).splitlines() or [""])[0]
            cause = f" with env.kwargs={kwargs}" if kwargs else ""
            raise ValueError(f"{id} cannot be made{cause}: {kind}{line}") from error
        seeds = np.random.SeedSequence(seed).generate_state(n_envs).tolist()
        super().__init__(id, vector, n_envs, len(vector.agents), seeds, device)


class ParallelEnvs:
    """N parallel environments as one of Gymnasium's vector environments, with a row per agent.

    Args:
        make: returns a parallel environment.
        n_envs: number of environments, N.
        kwargs: arguments of ``make``.

    Raises:
        ValueError: if the spaces of two agents differ, or agents come later.
    """

    def __init__(self, make: Callable, n_envs: int, kwargs: dict[str, object]):
        from gymnasium.vector.utils import batch_space, create_empty_array

        parameters = inspect.signature(make).parameters
        if "render_mode" in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            kwargs = {"render_mode": "rgb_array", **kwargs}
        self.envs = [make(**kwargs) for _ in range(n_envs)]
        self.render_mode, env = kwargs.get("render_mode"), self.envs[0]
        self.agents, self.metadata = list(env.possible_agents), env.metadata
        env.reset()
        if set(env.agents) != set(self.agents):
            raise ValueError("some of its agents come later, but each needs a lane from the start")
        self.single_observation_space = self._common(env.observation_space)
        self.single_action_space = self._common(env.action_space)
        n_lanes = n_envs * len(self.agents)
        self.actions = batch_space(self.single_action_space, n_lanes)
        self.batch = create_empty_array(self.single_observation_space, n_lanes)
        self.latest = [None] * n_lanes  # observations
        self.reward = np.zeros((n_envs, len(self.agents)))
        self.terminated = np.zeros(self.reward.shape, bool)

    def _common(self, space_of) -> "gymnasium.Space":
        first, *others = self.agents
        for agent in others:
            if space_of(agent) != space_of(first):
                raise ValueError(
                    f"the spaces of {first} and {agent} differ, but one policy acts for all agents"
                )
        return space_of(first)

    def reset(self, *, seed: list[int] | None = None) -> tuple[Any, dict]:
        for e, env in enumerate(self.envs):
            self._begin(e, env, seed and seed[e])
        return self._observations(), {}

    def step(self, actions: Any) -> tuple[Any, ...]:
        from gymnasium.vector.utils import iterate

        rows = iterate(self.actions, actions)
        for e, env in enumerate(self.envs):
            chosen = dict(zip(self.agents, rows))
            if not env.agents:
                self._begin(e, env)
                continue
            observed, rewards, ended, *_ = env.step({agent: chosen[agent] for agent in env.agents})
            self._observe(e, observed)
            for a, agent in enumerate(self.agents):
                self.reward[e, a] = rewards.get(agent, 0.0)
                self.terminated[e, a] |= ended.get(agent, False)
        is_over = np.array([[not env.agents] for env in self.envs])
        ends = (is_over & self.terminated).ravel(), (is_over & ~self.terminated).ravel()
        return self._observations(), self.reward.ravel(), *ends, {}

    def render(self) -> list[np.ndarray]:
        return [env.render() for env in self.envs]

    def close(self) -> None:
        for env in self.envs:
            env.close()

    def _begin(self, e, env, seed=None) -> None:
        self._observe(e, env.reset(seed=seed)[0])
        self.reward[e], self.terminated[e] = 0, False

    def _observe(self, e, observed) -> None:
        for a, agent in enumerate(self.agents):
            if agent in observed:
                self.latest[e * len(self.agents) + a] = observed[agent]

    def _observations(self) -> np.ndarray | dict | tuple:
        from gymnasium.vector.utils import concatenate

        return concatenate(self.single_observation_space, self.latest, self.batch)
