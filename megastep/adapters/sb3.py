# pyright: reportMissingImports=false
"""An environment of megastep as Stable-Baselines3's vector environment."""

from collections.abc import Iterable, Sequence

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from megastep.adapters.vector_env import VectorEnv
from megastep.types import Env, Tree, optional

#: What sb3-contrib's learners with masks call, in lanes that have it.
ACTION_MASKS = "action_masks"


class SB3VecEnv(VecEnv):
    """An environment of megastep as a `stable_baselines3.common.vec_env.VecEnv`, in NumPy. Wrap it
    in ``VecMonitor`` for statistics of episodes.

    A lane begins its next episode in the step that ends one, by a masked reset; the last
    observation is ``infos[lane]["terminal_observation"]``. ``env_method("action_masks")`` says
    which actions are allowed, as ``MaskablePPO`` asks. The metric ``success`` is also
    ``is_success``. An observation with the name of an attribute of `torch.nn.ModuleDict`, in which
    SB3 keeps a network for each, gets an underscore: ``keys`` of Keys is ``keys_``. Resets of the
    environment take masks. ``render_mode`` may be ``rgb_array``, for ``VecVideoRecorder``.
    """

    def __init__(self, env: Env, render_mode: str | None = None):
        self.vector = VectorEnv(env, AutoresetMode.SAME_STEP, render_mode=render_mode)
        self.env, self.render_mode = env, render_mode
        self._actions, self._infos = None, {}
        space = self.vector.single_observation_space
        is_dict = isinstance(space, gymnasium.spaces.Dict)
        self._names = _module_names(space) if is_dict else {}
        space = gymnasium.spaces.Dict(self._renamed(space)) if is_dict else space
        super().__init__(self.vector.num_envs, space, self.vector.single_action_space)
        self.metadata["render_fps"] = self.fps

    def reset(self) -> Tree:
        """Begins episodes in all lanes, with the seeds of ``seed``. Returns observations."""
        seeds = [*self._seeds]
        obs, self._infos = self.vector.reset(seed=None if None in seeds else seeds)
        self._reset_seeds()
        self._reset_options()
        return self._renamed(obs)

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps the actions (B, ...) for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[Tree, np.ndarray, np.ndarray, list[dict]]:
        """Returns (observations, rewards, dones, infos)."""
        obs, rewards, *flags, last = self.vector.step(self._actions)
        self._infos, (terminated, truncated) = last, flags
        over = np.logical_or(terminated, truncated)
        infos: list[dict] = [{} for _ in range(self.num_envs)]
        for lane in np.flatnonzero(over):
            metrics = last["final_info"].items()
            infos[lane] = {k: float(v[lane]) for k, v in metrics if not k.startswith("_")}
            success = infos[lane].get("success", np.nan)
            if not np.isnan(success):
                infos[lane]["is_success"] = success
            infos[lane]["terminal_observation"] = self._renamed(last["final_obs"][lane])
            infos[lane]["TimeLimit.truncated"] = bool(truncated[lane])
        return self._renamed(obs), rewards, over, infos

    def _renamed(self, parts) -> Tree:
        return {self._names[key]: parts[key] for key in parts} if self._names else parts

    def close(self) -> None:
        """Closes the environment."""
        self.vector.close()

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
        """Returns a method's result per lane; of ``action_masks`` each lane's own, (n,) bool."""
        if method_name == ACTION_MASKS:
            if "action_mask" not in self._infos:
                raise AttributeError(f"{type(self.env).__name__} masks no actions, or is not reset")
            masks = self._infos["action_mask"].reshape(self.num_envs, -1).astype(bool)
            return [masks[lane] for lane in self._get_indices(indices)]
        result = getattr(self.env, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type, indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """Returns False for each lane: wrap this object instead."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns a drawing (H, W, 3) uint8 of each lane with ``rgb_array``, otherwise None."""
        return self.vector.render() or [None] * self.num_envs

    @property
    def fps(self) -> float:
        """Steps per second of simulated time."""
        return optional(self.env, "fps")


def _module_names(space) -> dict[str, str]:
    """Returns the name of each observation that a ModuleDict can have, by the environment's."""
    modules, names = nn.ModuleDict(), {}
    for key in space:
        name = key.replace(".", "_")
        while hasattr(modules, name) or (name != key and name in {*space, *names.values()}):
            name += "_"
        names[key] = name
    return names
