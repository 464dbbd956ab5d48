"""Wrappers that change observations."""

import dataclasses
from typing import Annotated

import torch
from pydantic import Field

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.settings import checked
from megastep.types import Env, n_lanes
from megastep.wrappers.actions import Probability, normal
from megastep.wrappers.base import Draws, Wrapper, chosen, replaced

__all__ = ["DropSensor", "FrameStack", "NoisySensor"]

NUMBERS = spaces.MultiImage, spaces.MultiVector


class FrameStack(Wrapper):
    """Adds the last observations to each: images get more channels, vectors more numbers, the
    oldest first. At the start of an episode all are the first observation.

    Args:
        env: the environment inside.
        n: number of observations.
        sensors: dotted paths of those to stack. Default: all images and vectors.

    Raises:
        ValueError: there is no sensor of a name, or it is no image and no vector.
    """

    @checked
    def __init__(
        self,
        env: Env,
        *,
        n: Annotated[int, Field(ge=2, le=64)] = 4,
        sensors: tuple[str, ...] | None = None,
    ):
        super().__init__(env)
        leaves = spaces.leaves(env.obs_space)
        if sensors is None:
            sensors = tuple(name for name, one in leaves.items() if isinstance(one, NUMBERS))
        self.n, self.obs_space = n, env.obs_space
        self.frames: dict[str, torch.Tensor] = {}  # (B, n, A, ...) each
        for sensor in sensors or ("",):
            space = chosen(self, env.obs_space, sensor, NUMBERS)
            self.obs_space = replaced(self.obs_space, sensor, _stacked(space, n))
            dtype = getattr(space, "dtype", None) or torch.float32
            shape = n_lanes(env), n, *space.shape
            self.frames[sensor] = torch.zeros(shape, dtype=dtype, device=env.device)

    def after(self, world: arrdict) -> arrdict:
        """Returns the world with stacked observations."""
        leaves, obs = spaces.leaves(world.obs), world.obs
        for sensor, frames in self.frames.items():
            new = leaves[sensor][:, None]
            begins = world.reset.view(-1, *[1] * (frames.ndim - 1))
            new = new.to(frames.dtype)
            frames.copy_(torch.where(begins, new, torch.cat([frames[:, 1:], new], 1)))
            # (B, n, A, C, ...) -> (B, A, n C, ...)
            stacked = frames.transpose(1, 2).flatten(2, 3)
            obs = replaced(obs, sensor, stacked.to(leaves[sensor].dtype))
        return arrdict(world, obs=obs)


def _stacked(space, n) -> "spaces.MultiImage | spaces.MultiVector":
    pairs = ((name, getattr(space, name)) for name in ("low", "high"))
    bounds = {name: n * value for name, value in pairs if isinstance(value, tuple)}
    size = {"C": n * space.C} if isinstance(space, spaces.MultiImage) else {"dim": n * space.dim}
    return dataclasses.replace(space, **size, **bounds)


class DropSensor(Wrapper):
    """Sets a sensor's values to 0 with a probability, as if it failed.

    Args:
        env: the environment inside.
        sensor: its dotted path in observations, such as `rgb`.
        probability: in each step, per lane.
        seed: of the draws.

    Raises:
        ValueError: there is no such sensor, or it has integers.
    """

    @checked
    def __init__(
        self, env: Env, *, sensor: str = "", probability: Probability = 1.0, seed: int = 1
    ):
        super().__init__(env)
        chosen(self, env.obs_space, sensor, NUMBERS)
        self.sensor, self.probability, self.draws = sensor, probability, Draws(env, (), seed)

    def after(self, world: arrdict) -> arrdict:
        """Returns the world without the sensor in some lanes."""
        leaf = spaces.leaves(world.obs)[self.sensor]
        fails = (self.draws()[:, 0] < self.probability).view(-1, *[1] * (leaf.ndim - 1))
        return arrdict(world, obs=replaced(world.obs, self.sensor, leaf.masked_fill(fails, 0)))


class NoisySensor(Wrapper):
    """Adds nearly Gaussian noise to a sensor's values.

    Args:
        env: the environment inside.
        sensor: its dotted path in observations, such as `d`.
        std: standard deviation, in the units of the observation.
        seed: of the draws.

    Raises:
        ValueError: there is no such sensor, or it has integers.
    """

    @checked
    def __init__(
        self,
        env: Env,
        *,
        sensor: str = "",
        std: Annotated[float, Field(ge=0, le=10**6)] = 0.1,
        seed: int = 1,
    ):
        super().__init__(env)
        space = chosen(self, env.obs_space, sensor, NUMBERS)
        if getattr(space, "dtype", None) == torch.uint8:
            raise ValueError(
                f"NoisySensor: {sensor or 'obs'} has bytes, to which no noise is added"
            )
        self.sensor, self.std, self.draws = sensor, std, Draws(env, space.shape, seed)
        unbounded = dataclasses.replace(space, low=None, high=None)
        self.obs_space = replaced(env.obs_space, sensor, unbounded)

    def after(self, world: arrdict) -> arrdict:
        """Returns the world with noise."""
        leaf = spaces.leaves(world.obs)[self.sensor]
        noisy = (leaf.float() + self.std * normal(self.draws())).to(leaf.dtype)
        return arrdict(world, obs=replaced(world.obs, self.sensor, noisy))
