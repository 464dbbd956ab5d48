# pyright: reportMissingImports=false, reportArgumentType=false
"""An environment of megastep as TorchRL's."""

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, Unbounded
from torchrl.data.tensor_specs import TensorSpec
from torchrl.envs import EnvBase

from megastep import spaces
from megastep.adapters.lane_steps import Lanes, ended, fresh
from megastep.adapters.vector_env import as_dtype, without_agents
from megastep.types import Env, optional


class TorchRLEnv(EnvBase):
    """An environment of megastep, whose resets take masks, as a `torchrl.envs.EnvBase`,
    batch-locked: B lanes, on the environment's device. Floats of observations are of a dtype.

    Lanes begin episodes when TorchRL resets them, by a masked reset. Observations are the keys of
    the observation space, or ``observation``; ``privileged`` is one more, if there is one, and
    ``action_mask``, where the environment allows some actions only.
    """

    def __init__(self, env: Env, dtype: torch.dtype = torch.float32):
        self.lanes = Lanes(env, purpose="TorchRL")
        n, self.device_of_env = self.lanes.n_lanes, self.lanes.device
        super().__init__(device=self.device_of_env, batch_size=[n])
        self.megastep, self.dtype_of_obs, self._seeds = env, dtype, None
        self._space = dict(_named(env.obs_space, "observation"))
        if (privileged := optional(env, "privileged_space")) is not None:
            self._space["privileged"] = privileged
        on = dict(device=self.device_of_env)
        self.observation_spec = _spec(self._space, n, dtype, on)
        world = self.lanes.reset()
        self._is_masked = "mask" in world
        if self._is_masked:
            mask = without_agents(env.action_space, world["mask"])
            self.observation_spec["action_mask"] = _mask_spec(mask, n, on)
        action = _spec(env.action_space, n, torch.float32, on)
        self.full_action_spec = Composite({"action": action}, shape=[n], **on)
        self.reward_spec = Unbounded((n, 1), dtype=torch.float32, **on)
        flag = torch.empty(n, 1, dtype=torch.bool)
        flags = dict.fromkeys(("done", "terminated", "truncated"), flag)
        self.full_done_spec = _mask_spec(flags, n, on)

    def _tensordict(self, world) -> TensorDict:
        named = _named(world["obs"], "observation")
        named = {key: named[key] if key in named else world[key] for key in self._space}
        parts = without_agents(self._space, named)
        if self._is_masked:
            parts["action_mask"] = without_agents(self.megastep.action_space, world["mask"])
        flags = dict(done=ended(world), terminated=world["terminal"], truncated=world["truncated"])
        parts = fresh(parts | flags | dict(reward=world["reward"]))
        parts = {
            key: part[:, None] if key in (*flags, "reward") else as_dtype(part, self.dtype_of_obs)
            for key, part in parts.items()
        }
        return TensorDict(parts, batch_size=self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        seeds, self._seeds = self._seeds, None
        world = self.lanes.reset(seeds, None if mask is None else mask.reshape(-1))
        return self._tensordict(world).exclude("reward")

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        world, *_ = self.lanes.step(tensordict.get("action"))
        return self._tensordict(world)

    def _set_seed(self, seed: int | None) -> None:
        self._seeds = seed


def _named(space, name) -> Mapping:
    return space if isinstance(space, Mapping) else {name: space}


def _mask_spec(mask, n, on) -> TensorSpec:
    """Returns the spec of a mask, a tensor or a dict of them."""
    if isinstance(mask, Mapping):
        return Composite({k: _mask_spec(part, n, on) for k, part in mask.items()}, shape=[n], **on)
    return Categorical(2, shape=mask.shape, dtype=torch.bool, **on)


def _spec(space, n, dtype, on) -> TensorSpec:
    """Returns the spec of n lanes' leaves, (n, ...), without an axis of one agent per lane."""
    if isinstance(space, Mapping):
        parts = {k: _spec(part, n, dtype, on) for k, part in space.items()}
        return Composite(parts, shape=[n], **on)
    shape = n, *(space.shape[1:] if space.shape[0] == 1 else space.shape)
    if isinstance(space, spaces.MultiDiscrete):
        if len(shape) == 1:
            return Categorical(space.n_actions, shape=shape, dtype=torch.int64, **on)
        choices = [space.n_actions] * space.n_agents
        return MultiCategorical(choices, shape=shape, dtype=torch.int64, **on)
    if isinstance(space, spaces.MultiContinuous):
        low, high = (bound.expand(space.shape).reshape(shape[1:]) for bound in space.tensors())
        return Bounded(low.expand(shape), high.expand(shape), shape, dtype=torch.float32, **on)
    return Unbounded(shape, dtype=space.dtype if space.dtype == torch.uint8 else dtype, **on)
