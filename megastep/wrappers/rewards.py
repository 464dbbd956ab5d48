"""Wrappers that change rewards."""

from collections.abc import Callable
from typing import Annotated

import torch
from pydantic import Field

from megastep.arrdict import arrdict
from megastep.coefficients import Coefficients
from megastep.imports import import_object
from megastep.schedules import Number, Scheduled
from megastep.settings import checked
from megastep.types import Env
from megastep.wrappers.base import Wrapper

__all__ = ["ClipReward", "ScaleReward", "ShapeReward"]

Reward = Annotated[float, Field(ge=-(10**6), le=10**6)]


class ScaleReward(Wrapper):
    """Multiplies rewards by a factor.

    Args:
        env: the environment inside.
        factor: a number or a schedule.
    """

    @checked
    def __init__(
        self, env: Env, *, factor: Annotated[Number, Scheduled(ge=-(10**6), le=10**6)] = 1.0
    ):
        super().__init__(env)
        self.own_coefficients = (Coefficients(env.device, factor=factor),)

    def after(self, world: arrdict) -> arrdict:
        """Returns the world with scaled rewards."""
        (numbers,) = self.own_coefficients
        return arrdict(world, reward=world.reward * numbers.tensors["factor"])


class ClipReward(Wrapper):
    """Clips rewards.

    Args:
        env: the environment inside.
        min: smallest reward.
        max: largest reward.

    Raises:
        ValueError: `min` is above 0 or `max` below: the first reward of an episode is 0.
    """

    @checked
    def __init__(self, env: Env, *, min: Reward = -1.0, max: Reward = 1.0):
        super().__init__(env)
        if not min <= 0 <= max:
            raise ValueError(f"ClipReward: 0 must be between min={min:g} and max={max:g}")
        self.min, self.max = min, max

    def after(self, world: arrdict) -> arrdict:
        """Returns the world with clipped rewards."""
        return arrdict(world, reward=world.reward.clamp(self.min, self.max))


class ShapeReward(Wrapper):
    """Replaces rewards by those of a function.

    Args:
        env: the environment inside.
        function: import path of a function of a world, `module:function`, or the function. It
            returns the new rewards, (B,) float32, and does not change the world.

    Raises:
        ValueError: there is no such function, or it returns something else.
    """

    @checked
    def __init__(self, env: Env, *, function: str | Callable):
        super().__init__(env)
        self.function = import_object(function) if isinstance(function, str) else function
        if not callable(self.function):
            raise ValueError(f"ShapeReward: {function} is no function")

    def after(self, world: arrdict) -> arrdict:
        """Returns the world with other rewards; 0 at the start of an episode."""
        reward, expected = self.function(world), world.reward
        if not isinstance(reward, torch.Tensor) or reward.shape != expected.shape:
            given = tuple(reward.shape) if isinstance(reward, torch.Tensor) else repr(reward)
            raise ValueError(
                f"ShapeReward: {getattr(self.function, '__name__', 'the function')} must return "
                f"rewards of shape {tuple(expected.shape)}, not {given}"
            )
        return arrdict(world, reward=reward.to(expected.dtype).masked_fill(world.reset, 0.0))
