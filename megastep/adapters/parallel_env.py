# pyright: reportMissingImports=false
"""An environment of several agents as PettingZoo's parallel environment."""

import copy
from collections.abc import Mapping

import gymnasium
import numpy as np
import pettingzoo

from megastep import arrdict
from megastep.adapters.vector_env import VectorEnv, row
from megastep.types import Env, Tree, optional


class ParallelEnv(pettingzoo.ParallelEnv):  # pyright: ignore[reportGeneralTypeIssues]
    """An environment of megastep with N = 1 as a `pettingzoo.ParallelEnv`, in NumPy.

    All agents leave together, when the game is over: ``env.game_over``, or by default where the
    episodes of all agents end at once. An agent whose own episode ends before, as by a death in
    Deathmatch, plays on in the next step; its ``info`` has ``terminal`` or ``truncated`` then, and
    the episode's metrics. Where the environment allows some actions only, each ``info`` has them as
    ``action_mask``, int8. Play Deathmatch in rounds, ``resample=True``: otherwise it never ends.

    Agents have the names of ``env.roles``, numbered if several have the same (``hider_0``), or
    ``agent_0``, ``agent_1``, ... ``render_mode`` is None or ``rgb_array``.
    """

    def __init__(self, env: Env, render_mode: str | None = None):
        if env.n_envs != 1:
            raise ValueError(
                f"a parallel environment has n_envs=1, but this {type(env).__name__} has "
                f"{env.n_envs}"
            )
        self.vector = vector = VectorEnv(env, render_mode=render_mode)
        self.env, self.render_mode = env, render_mode
        roles = optional(env, "roles") or ("agent",) * vector.num_envs
        is_team = len({*roles}) < len(roles)
        numbers = [roles[:i].count(role) for i, role in enumerate(roles)]
        names = (f"{role}_{i}" if is_team else role for role, i in zip(roles, numbers))
        self.possible_agents = [*names]
        self.agents: list[str] = []
        self.metadata = {**vector.metadata, "name": f"{type(env).__name__.lower()}_v0"}
        self.observation_spaces, self.action_spaces = (
            {agent: copy.deepcopy(space) for agent in self.possible_agents}
            for space in (vector.single_observation_space, vector.single_action_space)
        )

    def observation_space(self, agent: str) -> gymnasium.Space:
        """Returns the space of an agent's observations, the same object each time."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        """Returns the space of an agent's actions, the same object each time."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping | None = None
    ) -> tuple[dict[str, Tree], dict[str, dict]]:
        """Begins a game. Returns (observations, infos) by agent. ``options`` are ignored."""
        self.agents = [*self.possible_agents]
        obs, infos = self.vector.reset(seed=seed)
        return self._rows(obs), self._masks(infos)

    def step(self, actions: Mapping[str, Tree]) -> tuple[dict, dict, dict, dict, dict]:
        """Steps all agents. Returns the usual five dicts by agent, empty once the game is over."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        chosen = arrdict.stack([actions[agent] for agent in self.possible_agents])
        obs, rewards, terminated, truncated, facts = self.vector.step(chosen)
        over = optional(self.env, "game_over")
        is_over = bool(np.logical_or(terminated, truncated).all() if over is None else over.all())
        infos = self._masks(facts)
        metrics = {k: v for k, v in facts.items() if k[0] != "_" and k != "action_mask"}
        for i, agent in enumerate(self.agents):
            if terminated[i] or truncated[i]:
                infos[agent]["terminal" if terminated[i] else "truncated"] = True
                infos[agent] |= {k: float(v[i]) for k, v in metrics.items()}
        flags = terminated & is_over, truncated & is_over
        parts = [dict(zip(self.agents, values.tolist())) for values in (rewards, *flags)]
        self.agents = [] if is_over else self.agents
        return self._rows(obs), parts[0], parts[1], parts[2], infos

    def _rows(self, batch) -> dict[str, Tree]:
        return {agent: row(batch, i) for i, agent in enumerate(self.possible_agents)}

    def _masks(self, infos) -> dict[str, dict]:
        """Returns an info for each agent, with the actions that are allowed to it now."""
        masks = {key: infos[key] for key in ("action_mask",) if key in infos}
        return {agent: row(masks, i) for i, agent in enumerate(self.agents)}

    def render(self) -> np.ndarray | None:
        """Returns a drawing (H, W, 3) uint8 if ``render_mode`` is ``rgb_array``."""
        frames = self.vector.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Closes the environment."""
        self.vector.close()
