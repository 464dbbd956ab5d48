"""Wrappers that make what robots have: delays, and odometry that drifts."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, cast

import torch
from pydantic import Field

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.modules.robots import headings
from megastep.settings import checked
from megastep.types import Env, Tree, n_lanes
from megastep.wrappers.base import Draws, Unmasked, Wrapper, along, zero_actions

__all__ = ["Latency", "OdometryDrift"]

Fraction = Annotated[float, Field(ge=0, le=1)]


class Latency(Unmasked):
    """Takes each action some steps late. Until then an episode's actions are 0.

    Args:
        env: the environment inside, without action masks.
        n: steps.
        per_episode: each episode has a delay of its own, from 0 to n.
        seed: of the draws.
    """

    @checked
    def __init__(
        self,
        env: Env,
        *,
        n: Annotated[int, Field(ge=1, le=1000)] = 1,
        per_episode: bool = False,
        seed: int = 1,
    ):
        super().__init__(env)
        self.n, self.draws = n, Draws(env, (), seed) if per_episode else None
        self.delays = torch.full((n_lanes(env),), n, device=env.device)
        self.last = zero_actions(env, n + 1)  # the newest first

    def before(self, actions: Tree) -> Tree:
        """Returns the actions of some steps ago."""

        def delay(_, last, new) -> torch.Tensor:
            last.copy_(torch.cat([new[:, None].to(last.dtype), last[:, :-1]], 1))
            index = along(self.delays, last).expand(-1, 1, *last.shape[2:])
            return last.gather(1, index)[:, 0]

        return spaces.map(delay, self.action_space, self.last, actions)

    def after(self, world: arrdict) -> arrdict:
        """Forgets actions, and draws delays, where episodes begin."""
        world = super().after(world)
        if self.draws is not None:
            self.delays.copy_(self.draws(world.reset)[:, 0] * (self.n + 1))

        def forget(_, last) -> torch.Tensor:
            return last.masked_fill_(along(world.reset, last), 0)

        spaces.map(forget, self.action_space, self.last)
        return world


class OdometryDrift(Wrapper):
    """Has PointGoal's ``goal`` be where an agent believes it to be that adds up its own motion. The
    errors are constant during an episode, and uniform up to these bounds on either side. Reward and
    success are those of the true position.

    Args:
        env: PointGoal.
        distance: error of the length of a movement, as a fraction of it.
        turn: error of a turn, as a fraction of it.
        veer: radians that a metre's drive adds to the error of the heading.
        seed: of the draws.
    """

    @checked
    def __init__(
        self,
        env: Env,
        *,
        distance: Fraction = 0.02,
        turn: Fraction = 0.02,
        veer: Fraction = 0.01,
        seed: int = 1,
    ):
        super().__init__(env)
        space = env.obs_space.get("goal") if isinstance(env.obs_space, Mapping) else None
        if not isinstance(space, spaces.MultiVector) or space.shape != (1, 3):
            raise ValueError("OdometryDrift: observations have no goal (1, 3); use PointGoal")
        self.agents = cast(Any, env).core.agents
        self.bounds = torch.tensor([distance, turn, veer], device=env.device)
        self.draws, n = Draws(env, (), seed), n_lanes(env)
        self.pose = torch.zeros((n, 3), device=env.device)  # x, y, degrees one step ago
        self.error = torch.zeros((n, 3), device=env.device)  # of what it believes

    def after(self, world: arrdict) -> arrdict:
        """Returns the world with the goal as believed."""
        scale = (self.draws(world.reset)[:, :3] * 2 - 1) * self.bounds
        position, angle = self.agents.positions.view(-1, 2), self.agents.angles.view(-1)
        moved, turned = position - self.pose[:, :2], angle - self.pose[:, 2]
        turned = turned - 360 * ((turned + 180) * (1 / 360)).floor()
        length = (moved * moved).sum(-1).sqrt()
        veered = scale[:, 2] * length * (180 / math.pi) + scale[:, 1] * turned
        degrees = self.error[:, 2] + veered
        begins = world.reset
        angles = torch.stack([degrees, -angle, -degrees.masked_fill(begins, 0)])
        believing, back, correcting = headings(angles)
        believed = _turned(moved, believing) * (1 + scale[:, :1])
        error = torch.cat([self.error[:, :2] + (believed - moved), degrees[:, None]], 1)
        self.error.copy_(error.masked_fill(begins[:, None], 0))
        self.pose.copy_(torch.cat([position, angle[:, None]], 1))
        goal = world.obs.goal[:, 0].float()
        offset = _turned(self.error[:, :2], back)
        seen = _turned(goal[:, :1] * 10 * goal[:, 1:] - offset, correcting)
        metres = (seen * seen).sum(-1, keepdim=True).sqrt()
        seen = torch.cat([metres * 0.1, seen / metres.clamp(min=1e-6)], 1)
        obs = arrdict(world.obs, goal=seen[:, None].to(world.obs.goal.dtype))
        return arrdict(world, obs=obs)


def _turned(vectors, heading) -> torch.Tensor:
    """Returns vectors (B, 2) turned by the angles of unit vectors (B, 2)."""
    (x, y), (c, s) = vectors.unbind(-1), heading.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y], -1)
