"""Wrappers that change observations or rewards."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, cast

import torch
from pydantic import Field

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.coefficients import Coefficients
from megastep.imports import import_object
from megastep.modules.robots import headings
from megastep.schedules import Number, Scheduled
from megastep.settings import checked, closest
from megastep.types import Env, Space, Tree, n_lanes
from megastep.wrappers.actions import Probability, normal
from megastep.wrappers.base import Draws, Levels, Wrapper, along

NUMBERS = spaces.MultiImage, spaces.MultiVector
Fraction = Annotated[float, Field(ge=0, le=1)]
Reward = Annotated[float, Field(ge=-(10**6), le=10**6)]


def _sensor(wrapper, sensor) -> Space:
    """Returns the space at a dotted path, "" for one that is no dict. ValueError if none."""
    leaves, name = spaces.leaves(wrapper.env.obs_space), type(wrapper).__name__
    if sensor not in leaves:
        hint = "leave sensor out" if "" in leaves else closest(sensor, leaves)
        raise ValueError(f"{name}: there is no sensor {sensor!r}; {hint}")
    if not isinstance(leaves[sensor], NUMBERS):
        words = " or ".join(kind.__name__ for kind in NUMBERS)
        raise ValueError(f"{name}: {sensor or 'obs'} is {leaves[sensor]!r}, and not {words}")
    return leaves[sensor]


def _replaced(tree, path, value) -> Tree:
    """Returns a tree with another leaf at a dotted path."""
    if not path:
        return value
    key, _, rest = path.partition(".")
    return type(tree)({**tree, key: _replaced(tree[key], rest, value)})


class FrameStack(Wrapper):
    """Adds the last observations to each: images get more channels, vectors more numbers, the
    oldest first. At the start of an episode all are the first observation.

    Args:
        n: number of observations.
        sensors: dotted paths of those to stack. Default: all images and vectors.
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
        if sensors is None:
            leaves = spaces.leaves(env.obs_space)
            sensors = tuple(name for name, one in leaves.items() if isinstance(one, NUMBERS))
        self.n, self.obs_space = n, env.obs_space
        self.frames: dict[str, torch.Tensor] = {}  # (B, n, A, ...) each
        for sensor in sensors or ("",):
            space = _sensor(self, sensor)
            self.obs_space = _replaced(self.obs_space, sensor, _stacked(space, n))
            shape, dtype = (n_lanes(env), n, *space.shape), space.dtype or torch.float32
            self.frames[sensor] = torch.zeros(shape, dtype=dtype, device=env.device)

    def after(self, world: arrdict) -> arrdict:
        """Returns the world with stacked observations."""
        leaves, obs = spaces.leaves(world.obs), world.obs
        for sensor, frames in self.frames.items():
            new = leaves[sensor][:, None].to(frames.dtype)
            older = torch.cat([frames[:, 1:], new], 1)
            frames.copy_(torch.where(along(world.reset, frames), new, older))
            # (B, n, A, C, ...) -> (B, A, n C, ...)
            stacked = frames.transpose(1, 2).flatten(2, 3)
            obs = _replaced(obs, sensor, stacked.to(leaves[sensor].dtype))
        return arrdict(world, obs=obs)


def _stacked(space, n) -> "spaces.MultiImage | spaces.MultiVector":
    pairs = ((name, getattr(space, name)) for name in ("low", "high"))
    bounds = {name: n * value for name, value in pairs if isinstance(value, tuple)}
    size = {"C": n * space.C} if isinstance(space, spaces.MultiImage) else {"dim": n * space.dim}
    return dataclasses.replace(space, **size, **bounds)


class DropSensor(Wrapper):
    """Sets a sensor's values to 0 with a probability, as if it failed.

    Args:
        sensor: its dotted path in observations, such as `rgb`.
        probability: in each step, per lane.
        per_value: each value fails by itself, as rays of a lidar do.
        per_episode: each episode has a probability of its own, uniform from 0 to this one.
        seed: of the draws.
    """

    @checked
    def __init__(
        self,
        env: Env,
        *,
        sensor: str = "",
        probability: Probability = 1.0,
        per_value: bool = False,
        per_episode: bool = False,
        seed: int = 1,
    ):
        super().__init__(env)
        shape = _sensor(self, sensor).shape
        self.sensor, self.probability = sensor, probability
        self.draws = Draws(env, shape if per_value else (), seed)
        self.levels = Levels(env, per_episode, seed)

    def after(self, world: arrdict) -> arrdict:
        """Returns the world without the sensor in some lanes."""
        leaf, numbers = spaces.leaves(world.obs)[self.sensor], self.draws()[..., 0]
        limits = self.probability * self.levels.begin(world.reset)
        fails = numbers < along(limits, numbers)
        fails = fails.view(*fails.shape, *[1] * (leaf.ndim - fails.ndim))
        return arrdict(world, obs=_replaced(world.obs, self.sensor, leaf.masked_fill(fails, 0)))


class NoisySensor(Wrapper):
    """Adds nearly Gaussian noise to a sensor's values.

    Args:
        sensor: its dotted path in observations, such as `d`.
        std: standard deviation, in the units of the observation.
        per_episode: each episode has a deviation of its own, uniform from 0 to this one.
        seed: of the draws.
    """

    @checked
    def __init__(
        self,
        env: Env,
        *,
        sensor: str = "",
        std: Annotated[float, Field(ge=0, le=10**6)] = 0.1,
        per_episode: bool = False,
        seed: int = 1,
    ):
        super().__init__(env)
        self.levels = Levels(env, per_episode, seed)
        space = _sensor(self, sensor)
        if space.dtype == torch.uint8:
            raise ValueError(
                f"NoisySensor: {sensor or 'obs'} has bytes, to which no noise is added"
            )
        self.sensor, self.std, self.draws = sensor, std, Draws(env, space.shape, seed)
        unbounded = dataclasses.replace(space, low=None, high=None)
        self.obs_space = _replaced(env.obs_space, sensor, unbounded)

    def after(self, world: arrdict) -> arrdict:
        """Returns the world with noise."""
        leaf = spaces.leaves(world.obs)[self.sensor]
        std = along(self.std * self.levels.begin(world.reset), leaf)
        noisy = (leaf.float() + std * normal(self.draws())).to(leaf.dtype)
        return arrdict(world, obs=_replaced(world.obs, self.sensor, noisy))


class ScaleReward(Wrapper):
    """Multiplies rewards by a factor.

    Args:
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
        min: smallest reward, at most 0: the first reward of an episode is 0.
        max: largest reward, at least 0.
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
        function: import path of a function of a world, `module:function`, or the function. It
            returns the new rewards, (B,) float32, and does not change the world.
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
