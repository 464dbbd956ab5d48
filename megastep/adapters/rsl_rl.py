# pyright: reportMissingImports=false
"""An environment of megastep as rsl_rl's vector environment."""

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from megastep import spaces
from megastep.adapters.lane_steps import Lanes, ended
from megastep.arrdict import arrdict
from megastep.envs.first_person import FirstPerson
from megastep.types import Env, Tree, World, optional


class _LimitedLanes(Lanes):
    """Steps lanes, and truncates episodes at a length; ``lengths`` (B,) int64 may be written."""

    def __init__(self, env: Env, longest: int):
        super().__init__(env, True, "rsl_rl")
        self.longest = longest
        self.lengths = torch.zeros(self.n_lanes, dtype=torch.int64, device=self.device)
        self.roots = env, self.lengths

    def _next_step(self, decision) -> tuple[World, World, torch.Tensor]:
        world: Tree = self.env.step(decision)
        over = ended(world)
        cut = (self.lengths.add_(1) >= self.longest) & ~over
        over = over | cut
        self.lengths.masked_fill_(over, 0)
        world = arrdict(world, truncated=world["truncated"] | cut)
        return world, world, over


class RslRlVecEnv(VecEnv):
    """An environment of megastep with continuous actions as an `rsl_rl.env.VecEnv`, on the device.

    Observations are groups of vectors (B, D) float32: ``policy`` has the observation, and
    ``critic`` the observation and the privileged one, if the environment has it. A lane begins its
    next episode in the step that ends one, by a masked reset; ``extras["time_outs"]`` says where a
    time limit ended it. Actions are clipped to their bounds. An episode is truncated when its
    length in ``episode_length_buf``, which may be written, is ``max_episode_length``. Resets of the
    environment take masks.
    """

    def __init__(self, env: Env):
        space = env.action_space
        if not isinstance(space, spaces.MultiContinuous) or space.n_agents != 1:
            raise ValueError(
                "rsl_rl acts by vectors of numbers, but the actions of this "
                f"{type(env).__name__} are {space!r}: use control='continuous', if it has that"
            )
        longest = optional(env, "max_episode_steps")
        if isinstance(env, FirstPerson):
            longest = getattr(env, "limit", longest)
        self.lanes, self.env, self.max_episode_length = _LimitedLanes(env, longest), env, longest
        self.num_envs, self.num_actions = self.lanes.n_lanes, space.dim
        self.device, self.cfg = self.lanes.device, {}
        self.low, self.high = space.tensors(self.device)
        self._world = self.lanes.reset()

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps of each lane's episode so far, (B,) int64; may be written."""
        return self.lanes.lengths

    @episode_length_buf.setter
    def episode_length_buf(self, lengths: torch.Tensor) -> None:
        self.lanes.lengths.copy_(lengths)

    def get_observations(self) -> TensorDict:
        """Returns the observation groups of now."""
        return self._groups(self._world)

    def reset(self) -> tuple[TensorDict, dict]:
        """Begins episodes in all lanes. Returns (observations, extras)."""
        self._world = self.lanes.reset()
        self.lanes.lengths.zero_()
        return self.get_observations(), {}

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Steps by actions (B, ``num_actions``). Returns (observations, rewards, dones, extras)."""
        actions = actions.detach().clamp(self.low, self.high)
        self._world, final, over = self.lanes.step(actions)
        extras = dict(time_outs=final["truncated"].clone())
        return self._groups(self._world), final["reward"].clone(), over.clone(), extras

    def _groups(self, world) -> TensorDict:
        groups = dict(policy=_flat(world["obs"]))
        if "privileged" in world:
            groups["critic"] = torch.cat([groups["policy"], _flat(world["privileged"])], 1)
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)


def _flat(tree) -> torch.Tensor:
    """Returns a tree of tensors (B, ...) as one of shape (B, D) float32."""
    leaves = spaces.leaves(tree).values()
    return torch.cat([leaf.flatten(1).float() for leaf in leaves], 1)
