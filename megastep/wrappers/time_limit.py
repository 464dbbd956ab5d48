"""A wrapper that limits the length of episodes."""

from typing import Annotated

import torch
from pydantic import Field

from megastep.arrdict import arrdict
from megastep.settings import checked
from megastep.types import Env, n_lanes
from megastep.wrappers.base import Wrapper

__all__ = ["TimeLimit"]


class TimeLimit(Wrapper):
    """Truncates episodes after a number of steps. The next step begins a new one, which costs a
    second rendering of every step.

    Metrics of an episode that it truncates are what the environment gives at that step: 0, where it
    computes them at the end of its own episodes.

    Args:
        env: the environment inside, with ``reset(seed=None, mask=None)``.
        n: steps after the first observation.

    Raises:
        ValueError: the environment cannot begin episodes of some lanes alone.
    """

    @checked
    def __init__(self, env: Env, *, n: Annotated[int, Field(ge=1, le=10**9)]):
        super().__init__(env)
        self.require_masks("begins episodes of lanes that it has truncated")
        self.n = n
        self.ages = torch.zeros(n_lanes(env), dtype=torch.int32, device=env.device)
        self.is_cut = torch.zeros(n_lanes(env), dtype=torch.bool, device=env.device)

    def step(self, decision) -> arrdict:
        """Takes one step. Returns a world."""
        self.env.step(decision)
        return self._resets.keep(self.after(self.restarted(self.is_cut)))

    def after(self, world: arrdict) -> arrdict:
        """Returns the world, truncated where an episode is at its limit."""
        self.ages.add_(1).masked_fill_(world.reset, 0)
        ends = world.terminal | world.truncated
        self.is_cut.copy_((self.ages >= self.n) & ~ends & ~world.reset)
        return arrdict(world, truncated=world.truncated | self.is_cut)
