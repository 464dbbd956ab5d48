# pyright: reportMissingImports=false
"""An environment of several agents as PettingZoo's parallel environment."""

from collections.abc import Mapping

import gymnasium
import numpy as np
import pettingzoo
import torch

from megastep.adapters.gymnasium_spaces import (
    action_mask,
    as_dtype,
    gymnasium_space,
    int8,
    render_modes,
    row,
    stacked,
    to_numpy,
    without_agents,
)
from megastep.adapters.lane_steps import Lanes
from megastep.plotting import rasterise
from megastep.types import Env, Tree, optional

__all__ = ["ParallelEnv"]


class ParallelEnv(pettingzoo.ParallelEnv):  # pyright: ignore[reportGeneralTypeIssues]
    """An environment of megastep with N = 1 as a `pettingzoo.ParallelEnv`, in NumPy.

    All agents leave together, when the game is over: ``env.game_over``, or by default where the
    episodes of all agents end at once. An agent whose own episode ends before, as by a death in
    Deathmatch, plays on in the next step; its ``info`` has ``terminal`` or ``truncated`` then, and
    the episode's metrics. Where the environment allows some actions only, each ``info`` has them as
    ``action_mask``, int8. Play Deathmatch in rounds, ``resample=True``: otherwise it never ends.

    Args:
        env: the environment, of one environment. Agents have the names of its ``roles``, or
            ``agent_0``, ``agent_1``, ...
        render_mode: None or ``rgb_array``.

    Raises:
        ValueError: if there are several environments.
    """

    def __init__(self, env: Env, render_mode: str | None = None):
        if env.n_envs != 1:
            raise ValueError(
                f"a parallel environment has n_envs=1, but this {type(env).__name__} has "
                f"{env.n_envs}"
            )
        self.lanes, self.env = Lanes(env), env
        roles = optional(env, "roles")
        self.possible_agents = [*(roles or (f"agent_{i}" for i in range(self.lanes.n_lanes)))]
        self.agents: list[str] = []
        self.render_mode, modes = render_mode, render_modes(env, render_mode)
        fps, name = optional(env, "fps"), type(env).__name__.lower()
        self.metadata = dict(name=f"{name}_v0", render_modes=modes, render_fps=fps)
        self.observation_spaces, self.action_spaces = (
            {agent: gymnasium_space(space, torch.float32) for agent in self.possible_agents}
            for space in (env.obs_space, env.action_space)
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
        world = self.lanes.reset(seed)
        return self._observations(world), self._masks(world)

    def step(self, actions: Mapping[str, Tree]) -> tuple[dict, dict, dict, dict, dict]:
        """Steps all agents. Returns (observations, rewards, terminations, truncations, infos) by
        agent.
        """
        world, _, ended = self.lanes.step(
            stacked([actions[agent] for agent in self.possible_agents])
        )
        over = optional(self.env, "game_over")
        is_over = bool(ended.all() if over is None else over.all())
        names = "reward", "terminal", "truncated"
        values = to_numpy({name: world[name] for name in names})
        metrics = to_numpy(dict(world.get("metrics", {})))
        infos = self._masks(world)
        for i, agent in enumerate(self.agents):
            flags = {name: True for name in names[1:] if values[name][i]}
            infos[agent] |= flags and flags | {k: float(v[i]) for k, v in metrics.items()}
        rewards, terminations, truncations = (
            dict(zip(self.agents, values[name].tolist())) for name in names
        )
        if not is_over:
            terminations, truncations = (dict.fromkeys(self.agents, False) for _ in range(2))
        observations = self._observations(world)
        if is_over:
            self.agents = []
        return observations, rewards, terminations, truncations, infos

    def _observations(self, world) -> dict[str, Tree]:
        obs = as_dtype(without_agents(self.env.obs_space, world["obs"]), torch.float32)
        batch = to_numpy(obs)
        return {agent: row(batch, i) for i, agent in enumerate(self.possible_agents)}

    def _masks(self, world) -> dict[str, dict]:
        """Returns an info for each agent, with the actions that are allowed to it now."""
        if "mask" not in world:
            return {agent: {} for agent in self.agents}
        batch = int8(to_numpy(action_mask(self.env.action_space, world["mask"])))
        return {agent: {"action_mask": row(batch, i)} for i, agent in enumerate(self.agents)}

    def render(self) -> np.ndarray | None:
        """Returns a drawing (H, W, 3) uint8 if ``render_mode`` is ``rgb_array``."""
        drawn: Tree = self.env
        return None if self.render_mode is None else rasterise(drawn.display())

    def close(self) -> None:
        """Closes the environment."""
        self.lanes.close()
