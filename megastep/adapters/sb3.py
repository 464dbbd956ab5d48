# pyright: reportMissingImports=false
"""An environment of megastep as Stable-Baselines3's vector environment."""

import warnings
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv

from megastep.adapters.gymnasium_spaces import (
    action_mask,
    as_dtype,
    gymnasium_space,
    row,
    to_numpy,
    without_agents,
)
from megastep.adapters.lane_steps import Lanes
from megastep.types import Env, Tree, optional

__all__ = ["SB3VecEnv"]

#: Lanes above which the library's Python and NumPy take most of the time.
MANY_LANES = 4096
#: What sb3-contrib's learners with masks call, in lanes that have it.
ACTION_MASKS = "action_masks"


class SB3VecEnv(VecEnv):
    """An environment of megastep as a `stable_baselines3.common.vec_env.VecEnv`, in NumPy. Wrap it
    in ``VecMonitor`` for statistics of episodes.

    A lane begins its next episode in the step that ends one, by a masked reset; the last
    observation is ``infos[lane]["terminal_observation"]``. Where the environment allows some
    actions only, ``env_method("action_masks")`` says which, as sb3-contrib's ``MaskablePPO`` asks.

    Args:
        env: the environment, whose resets take masks.

    Raises:
        ValueError: if they do not.
    """

    def __init__(self, env: Env):
        self.lanes, self.env = Lanes(env, True, "Stable-Baselines3"), env
        n = self.lanes.n_lanes
        if n > MANY_LANES:
            warnings.warn(
                f"{n:,} lanes are more than {MANY_LANES:,}: Stable-Baselines3 handles each in "
                "Python on the host, which takes most of the time; rsl_rl, TorchRL and our own "
                "learners keep tensors on the device",
                stacklevel=2,
            )
        self.render_mode = None
        self._actions: Tree = None
        self._masks: np.ndarray | None = None  # (B, n), of all agents of a lane side by side
        super().__init__(
            n,
            gymnasium_space(env.obs_space, torch.float32),
            gymnasium_space(env.action_space, torch.float32),
        )

    def _observations(self, world) -> Tree:
        obs = without_agents(self.env.obs_space, world["obs"])
        return to_numpy(as_dtype(obs, torch.float32))

    def _keep_masks(self, world) -> None:
        if "mask" in world:
            masks = to_numpy(action_mask(self.env.action_space, world["mask"]))
            self._masks = masks.reshape(self.num_envs, -1)

    def reset(self) -> Tree:
        """Begins episodes in all lanes, with the seeds of ``seed``, if it was called. Returns
        observations.
        """
        seeds = [*self._seeds]
        world = self.lanes.reset(None if None in seeds else seeds)
        self._reset_seeds()
        self._reset_options()
        self._keep_masks(world)
        return self._observations(world)

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps the actions (B, ...) for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[Tree, np.ndarray, np.ndarray, list[dict]]:
        """Returns (observations, rewards, dones, infos)."""
        world, final, ended = self.lanes.step(self._actions)
        self._keep_masks(world)
        over, truncated = to_numpy(ended), to_numpy(final["truncated"])
        infos: list[dict] = [{} for _ in range(self.num_envs)]
        if over.any():
            last = self._observations(final)
            metrics = to_numpy(dict(final.get("metrics", {})))
            for lane in np.flatnonzero(over):
                infos[lane] = {name: float(values[lane]) for name, values in metrics.items()}
                infos[lane]["terminal_observation"] = row(last, lane)
                infos[lane]["TimeLimit.truncated"] = bool(truncated[lane])
        return self._observations(world), to_numpy(final["reward"]), over, infos

    def close(self) -> None:
        """Closes the environment."""
        self.lanes.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list:
        """Returns an attribute of the environment, once per lane."""
        if attr_name == ACTION_MASKS:
            return self.env_method(attr_name, indices=indices)
        value = self.render_mode if attr_name == "render_mode" else getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(
        self, attr_name: str, value: object, indices: int | Iterable[int] | None = None
    ) -> None:
        """Raises ValueError: lanes share an environment."""
        raise ValueError(f"{attr_name} cannot be set in single lanes, which share an environment")

    def env_method(
        self,
        method_name: str,
        *args: object,
        indices: int | Iterable[int] | None = None,
        **kwargs: object,
    ) -> list:
        """Calls a method of the environment once. Returns its result, once per lane; of
        ``action_masks`` each lane's own, (n,) bool.
        """
        if method_name == ACTION_MASKS:
            if self._masks is None:
                raise AttributeError(f"{type(self.env).__name__} masks no actions, or is not reset")
            return [self._masks[lane] for lane in self._get_indices(indices)]
        result = getattr(self.env, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type, indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """Returns False for each lane: wrap this object instead."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns None for each lane: use ``megastep.recording.film``."""
        return [None] * self.num_envs

    @property
    def fps(self) -> float:
        """Steps per second of simulated time."""
        return optional(self.env, "fps")
