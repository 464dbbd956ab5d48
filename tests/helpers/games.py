"""A toy game for two or more agents, and fixed policies that play it."""

import torch

from megastep import spaces
from megastep.arrdict import arrdict


class Matrix:
    """Agents choose one of three numbers. The highest gets reward 1, the lowest -1.

    A step ends the episode of every agent, unless all numbers are equal. Agents observe their slot,
    and nothing of the others.

    Args:
        mortal: a step ends only the episodes of agents below the highest number.
        limit: steps after which an episode is truncated.
        geometries: homes, for `layout`; they change nothing else.

    Attributes:
        played: the actions of each step, (n_envs, n_agents).
    """

    obs_space, action_space = spaces.MultiVector(1, 6), spaces.MultiDiscrete(1, 3)

    def __init__(
        self, n_envs=8, n_agents=2, mortal=False, limit=10**9, roles=None, geometries=None
    ):
        self.n_envs, self.n_agents, self.device = n_envs, n_agents, torch.device("cpu")
        self.n_lanes, self.mortal, self.limit, self.roles = n_envs * n_agents, mortal, limit, roles
        self.layout, self.played = None, []
        if geometries is not None:
            self.layout = torch.arange(n_envs, dtype=torch.int32) % len(geometries)

    def reset(self):
        self.age = torch.zeros(self.n_lanes, dtype=torch.int64)
        none = torch.zeros(self.n_lanes, dtype=torch.bool)
        self.over = none
        return self._world(torch.zeros(self.n_lanes), none, none, ~none)

    def step(self, decision):
        actions, new = decision.actions.view(self.n_envs, self.n_agents), self.over
        self.played.append(actions.clone())
        best, worst = actions.amax(1, keepdim=True), actions.amin(1, keepdim=True)
        reward = ((actions == best).float() - (actions == worst).float()).flatten()
        uneven = (best > worst).expand_as(actions)
        terminal = (uneven & (actions < best) if self.mortal else uneven).flatten() & ~new
        self.age = torch.where(new, 0, self.age + 1)
        truncated = (self.age == self.limit) & ~terminal
        self.over = terminal | truncated
        return self._world(self.scored(reward.masked_fill(new, 0.0)), terminal, truncated, new)

    def scored(self, reward):
        return reward

    def _world(self, reward, terminal, truncated, reset):
        slot = torch.eye(6)[: self.n_agents].repeat(self.n_envs, 1)[:, None]
        return arrdict(
            obs=slot,
            reward=reward,
            reset=reset,
            terminal=terminal,
            truncated=truncated,
            metrics=arrdict(points=reward.clone()),
        )


class Always:
    """Chooses `action`, or with probability `chance` a random number. Its hidden state counts the
    steps since a reset.
    """

    def __init__(self, action=2, chance=0.0, n_actions=3):
        self.action, self.chance, self.n_actions = action, chance, n_actions

    def initial(self, n_lanes, device="cpu"):
        return arrdict(steps=torch.zeros(n_lanes, device=device))

    def __call__(self, world, state, sample=True, generator=None):
        n, device = len(world["reset"]), world["reset"].device
        other = torch.rand(n, generator=generator, device=device) < self.chance
        drawn = torch.randint(self.n_actions, (n,), generator=generator, device=device)
        steps = state.steps.masked_fill(world["reset"], 0) + 1
        actions = torch.where(other, drawn, self.action)[:, None]
        return arrdict(actions=actions), arrdict(steps=steps)


class High(Always):
    """Always chooses the highest number. Needs no arguments, so it can be a `bot_class`."""


class Middle(Always):
    """Always chooses the middle number."""

    def __init__(self):
        super().__init__(1)
