"""Toy environments of two agents and more, and policies for them that need no learning."""

import torch

from megastep import spaces
from megastep.arrdict import arrdict


class Matrix:
    """Agents choose one of three numbers, every step is an episode: terminal for all, unless the
    numbers are equal. Whoever's is higher is paid 1, whoever's is lower -1; agents are shown their
    place, and who else plays is not to be seen.

    `mortal`: terminal for those alone that chose less than the highest. `geometries` are homes that
    nobody sees.
    """

    fps = 1.0
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
        paid = ((actions == best).float() - (actions == worst).float()).flatten()
        uneven = (best > worst).expand_as(actions)
        ended = (uneven & (actions < best) if self.mortal else uneven).flatten() & ~new
        self.age = torch.where(new, 0, self.age + 1)
        cut = (self.age == self.limit) & ~ended
        self.over = ended | cut
        return self._world(self.scored(paid.masked_fill(new, 0.0)), ended, cut, new)

    def scored(self, reward):
        return reward

    def _world(self, reward, terminal, truncated, reset):
        place = torch.eye(6)[: self.n_agents].repeat(self.n_envs, 1)[:, None]
        return arrdict(
            obs=place,
            reward=reward,
            reset=reset,
            terminal=terminal,
            truncated=truncated,
            metrics=arrdict(paid=reward.clone()),
        )

    def check(self):
        pass


class Always:
    """Chooses the same number for ever, or with `chance` another, evenly. Its memory counts steps
    since a reset.
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
    """The highest number: what `bot_class=tests.helpers.games:High` makes."""


class Middle(Always):
    def __init__(self):
        super().__init__(1)
