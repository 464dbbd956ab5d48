"""Wrappers that change actions or the length of episodes."""

from collections.abc import Mapping
from typing import Annotated, Any, cast

import torch
from pydantic import Field

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.settings import checked
from megastep.types import Env, Tree, n_lanes
from megastep.wrappers.base import Draws, Levels, Unmasked, Wrapper, along, zero_actions

__all__ = ["Latency", "NoisyActions", "StickyActions", "TimeLimit"]

Probability = Annotated[float, Field(ge=0, le=1)]


class StickyActions(Unmasked):
    """Repeats a lane's last action with a probability, whatever the policy chose (Machado et al.
    2018). The first action of an episode is always the policy's.

    Args:
        env: the environment inside, without action masks.
        probability: of repeating, in each step.
        seed: of the draws.
    """

    @checked
    def __init__(self, env: Env, *, probability: Probability = 0.25, seed: int = 1):
        super().__init__(env)
        self.probability, self.draws = probability, Draws(env, (), seed)
        self.is_first = torch.ones(n_lanes(env), dtype=torch.bool, device=env.device)
        self.last = zero_actions(env)

    def before(self, actions: Tree) -> Tree:
        """Returns the last actions in lanes that repeat them."""
        repeats = (self.draws()[:, 0] < self.probability) & ~self.is_first

        def stick(_, last, new) -> torch.Tensor:
            return last.copy_(torch.where(along(repeats, new), last, new)).clone()

        return spaces.map(stick, self.action_space, self.last, actions)

    def after(self, world: arrdict) -> arrdict:
        """Notes where episodes begin."""
        self.is_first.copy_(world.reset)
        return super().after(world)


class NoisyActions(Unmasked):
    """Replaces discrete actions by random ones with a probability, and adds noise to continuous
    ones.

    Args:
        env: the environment inside, without action masks.
        probability: of a random action, in each step, per agent of a lane.
        std: standard deviation of the noise, in units of half the range of an action. Actions stay
            within their bounds.
        per_episode: each episode has a probability and a deviation of its own, the same fraction of
            these, uniform from 0 to 1.
        seed: of the draws.
    """

    @checked
    def __init__(
        self,
        env: Env,
        *,
        probability: Probability = 0.1,
        std: Annotated[float, Field(ge=0, le=10)] = 0.1,
        per_episode: bool = False,
        seed: int = 1,
    ):
        super().__init__(env)
        self.probability, self.std = probability, std
        leaves = [*spaces.leaves(env.action_space).values()]
        #: Bounds of continuous actions, made once: a step copies nothing to the device.
        self.bounds = [
            space.tensors(env.device) if isinstance(space, spaces.MultiContinuous) else None
            for space in leaves
        ]
        self.draws = [Draws(env, space.shape, seed + (i << 40)) for i, space in enumerate(leaves)]
        self.levels = Levels(env, per_episode, seed)

    def before(self, actions: Tree) -> Tree:
        """Returns the actions with noise."""
        draws, levels, all_bounds = iter(self.draws), self.levels.values, iter(self.bounds)

        def disturb(space, leaf) -> torch.Tensor:
            numbers, bounds = next(draws)(), next(all_bounds)
            if isinstance(space, spaces.MultiDiscrete):
                n = space.n_actions
                others = (numbers[..., 1] * n).to(leaf.dtype).clamp(max=n - 1)
                is_random = numbers[..., 0] < along(self.probability * levels, leaf)
                return torch.where(is_random, others, leaf)
            low, high = cast(Any, bounds)
            noise = along(self.std * levels, leaf) * ((high - low) * 0.5) * normal(numbers)
            return torch.minimum(torch.maximum(leaf + noise, low), high)

        return spaces.map(disturb, self.action_space, actions)

    def after(self, world: arrdict) -> arrdict:
        """Draws how strong the noise is where episodes begin."""
        self.levels.begin(world.reset)
        return super().after(world)


def normal(numbers: torch.Tensor) -> torch.Tensor:
    """Returns nearly Gaussian numbers from four uniform ones each, (..., 4) -> (...)."""
    a, b, c, d = numbers.unbind(-1)
    return ((a + b) + (c + d) - 2.0) * 3**0.5


class TimeLimit(Wrapper):
    """Truncates episodes after a number of steps. The next step begins a new one, which costs a
    second rendering of every step.

    Metrics of an episode that it truncates are what the environment gives at that step: 0, where it
    computes them at the end of its own episodes.

    Args:
        env: the environment inside, with ``reset(seed=None, mask=None)``.
        n: steps after the first observation.
    """

    @checked
    def __init__(self, env: Env, *, n: Annotated[int, Field(ge=1, le=10**9)]):
        super().__init__(env)
        if not self.takes_masks:
            raise ValueError(
                "TimeLimit begins episodes of lanes that it has truncated, for which "
                f"{type(env).__name__} needs reset(seed=None, mask=None), as "
                "docs/new-environment.md says under The contract; wrap it with a wrapper of its "
                "own package, if it has one"
            )
        self.n = n
        self.ages = torch.zeros(n_lanes(env), dtype=torch.int32, device=env.device)
        self.is_cut = torch.zeros(n_lanes(env), dtype=torch.bool, device=env.device)

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step. Returns a world."""
        self.env.step(decision)
        return self._resets.keep(self.after(self.restarted(self.is_cut)))

    def after(self, world: arrdict) -> arrdict:
        """Returns the world, truncated where an episode is at its limit."""
        self.ages.add_(1).masked_fill_(world.reset, 0)
        ends = world.terminal | world.truncated
        self.is_cut.copy_((self.ages >= self.n) & ~ends & ~world.reset)
        return arrdict(world, truncated=world.truncated | self.is_cut)


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
