"""The base class of wrappers around environments."""

from collections.abc import Callable, Mapping
from typing import cast

import torch

from megastep import engine, spaces
from megastep.arrdict import arrdict
from megastep.coefficients import Coefficients
from megastep.modules.lifecycle import CounterGenerator
from megastep.types import Env, Space, Tree, n_lanes, takes_masks

__all__ = ["Draws", "Levels", "Wrapper"]


class Wrapper:
    """An environment around another one, which changes its actions, worlds or both. All other
    attributes are those of the environment inside.

    A subclass has `before`, `after` or both, sets `obs_space` or `action_space` if it changes them,
    and keeps what changes in tensors with a row per lane, changed in place: checkpoints hold them,
    and CUDA graphs repeat them. Its other constructor arguments are settings.

    Args:
        env: the environment inside.
    """

    env: Env
    n_envs: int
    device: torch.device
    obs_space: Space
    action_space: Space
    #: Its own numbers that may have schedules.
    own_coefficients: tuple[Coefficients, ...] = ()

    def __init__(self, env: Env):
        self.env = env
        inside = getattr(env, "_resets", None)
        last = tuple(f"env.{name}" for name in getattr(inside, "lanes_last", ()))
        self._resets = engine.Resets(last, getattr(inside, "draws", None))

    def __getattr__(self, name: str) -> object:
        if name == "env" or name.startswith("_"):  # not set yet while the object is being copied
            raise AttributeError(name)
        return getattr(self.env, name)

    def before(self, actions: Tree) -> Tree:
        """Returns the actions that the environment inside gets, (B, ...) per leaf."""
        return actions

    def after(self, world: arrdict) -> arrdict:
        """Returns a world from that of the environment inside, which stays as it is. Where
        `world.reset` is true an episode begins.
        """
        return world

    def reset(
        self, seed: "int | torch.Tensor | None" = None, mask: torch.Tensor | None = None
    ) -> arrdict:
        """Starts new episodes, as the environment inside does. Returns a world."""
        if (seed is not None or mask is not None) and not self.takes_masks:
            raise TypeError(f"{type(self.env).__name__} has no reset(seed=None, mask=None)")

        def begin(chosen) -> arrdict:
            whole: Callable = self.env.reset
            return self.after(whole() if mask is None else self.restarted(chosen))

        return self._resets(self, begin, seed, mask)

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step by ``decision["actions"]``. Returns a world."""
        world = self.env.step(arrdict(actions=self.before(decision["actions"])))
        return self._resets.keep(self.after(cast(arrdict, world)))

    def restarted(self, mask: torch.Tensor) -> arrdict:
        """Returns the last world inside, in which lanes of a mask (B,) have begun new episodes."""
        reset: Callable = self.env.reset
        return reset(mask=mask)

    @property
    def takes_masks(self) -> bool:
        """Whether `reset` takes a seed and a mask, as that of the environment inside."""
        return takes_masks(self.env)

    @property
    def coefficients(self) -> tuple[Coefficients, ...]:
        """Numbers that may have schedules, of the environment inside and its own."""
        return *getattr(self.env, "coefficients", ()), *self.own_coefficients


class Unmasked(Wrapper):
    """Base of wrappers that change actions. ValueError: the environment has action masks."""

    def after(self, world: arrdict) -> arrdict:
        if "mask" in world:
            name = type(self).__name__
            raise ValueError(f"{name} would take actions that the environment's mask forbids")
        return world


class Draws:
    """Uniform numbers in [0, 1), equal on CPU and GPU, of a shape for each lane of an environment.
    A seed is from 0 to 2**64 - 1.
    """

    def __init__(self, env: Env, shape: tuple[int, ...], seed: int):
        n = int(torch.Size(shape).numel()) * n_lanes(env)
        self.shape = n_lanes(env), *shape, 4
        self.generator = CounterGenerator(n, seed, env.device)
        self.all = torch.ones(n, dtype=torch.bool, device=env.device)

    def __call__(self, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Returns (B, *shape, 4) float32, valid until the next call: new numbers, or, for the shape
        (), those of the last call outside of a mask (B,).
        """
        return self.generator(self.all if mask is None else mask).view(self.shape)


class Levels:
    """How strong a disturbance is in each lane: 1, or, ``per_episode``, uniform in [0, 1) and drawn
    where an episode begins.
    """

    def __init__(self, env: Env, per_episode: bool, seed: int):
        self.draws = Draws(env, (), seed + (1 << 50)) if per_episode else None
        self.values = torch.ones(n_lanes(env), device=env.device)

    def begin(self, reset: torch.Tensor) -> torch.Tensor:
        """Draws the levels of lanes that begin an episode, (B,) bool. Returns all, (B,)."""
        if self.draws is not None:
            self.values.copy_(self.draws(reset)[:, 0])
        return self.values


def zero_actions(env: Env, *rows: int) -> Tree:
    """Returns zeros for the actions of each lane, (B, *rows, ...) per leaf."""

    def zeros(space) -> torch.Tensor:
        dtype = torch.int64 if isinstance(space, spaces.MultiDiscrete) else torch.float32
        return torch.zeros(n_lanes(env), *rows, *space.shape, dtype=dtype, device=env.device)

    return spaces.map(zeros, env.action_space)


def along(values: torch.Tensor, leaf: torch.Tensor) -> torch.Tensor:
    """Returns values (B,) in a shape that broadcasts with a leaf (B, ...)."""
    return values.view(-1, *[1] * (leaf.ndim - 1))
