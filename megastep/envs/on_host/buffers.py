"""Host memory through which worlds reach the learner's device and actions come back."""

from collections.abc import Sequence

import numpy as np
import torch

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.contract import FLAGS
from megastep.dotdict import leaves
from megastep.types import Space, Tree

__all__ = ["HostBuffers"]


class HostBuffers:
    """Buffers of a world and of actions. With a GPU they are pinned, so copies need no staging.

    Args:
        n_lanes: number of lanes, B.
        obs_space: space of one lane's observation.
        action_space: space of one lane's actions.
        device: where worlds go and actions come from.
        metrics: names of the metrics in worlds.
        flags: names of the bools in worlds.
        n_masked: actions of the mask in worlds; 0 without.
    """

    IS_STATELESS = True  # see :mod:`megastep.engine.state_tree`

    def __init__(
        self,
        n_lanes: int,
        obs_space: Space,
        action_space: Space,
        device: torch.device,
        metrics: Sequence[str] = (),
        flags: Sequence[str] = FLAGS,
        n_masked: int = 0,
    ):
        self.device, self.on_gpu = device, device.type == "cuda"

        def empty(dtype, *shape) -> torch.Tensor:
            return torch.empty((n_lanes, *shape), dtype=dtype, pin_memory=self.on_gpu)

        def of_space(space) -> torch.Tensor:
            dtypes = {spaces.MultiDiscrete: torch.int64, spaces.MultiContinuous: torch.float32}
            return empty(dtypes.get(type(space)) or space.dtype, *space.shape)

        self.world = arrdict(
            obs=spaces.map(of_space, obs_space),
            reward=empty(torch.float32),
            **{name: empty(torch.bool) for name in flags},
        )
        if metrics:
            self.world["metrics"] = arrdict({name: empty(torch.float32) for name in metrics})
        if n_masked:
            self.world["mask"] = empty(torch.bool, 1, n_masked)
        self.actions = spaces.map(of_space, action_space)
        self.arrays = [leaf.numpy() for leaf in leaves(self.world)]
        self.copied = torch.cuda.Event() if self.on_gpu else None

    def send(self, world: arrdict) -> arrdict:
        """Returns a world of arrays as one of new tensors on the device."""
        pairs = zip(self.arrays, leaves(world), strict=True)
        if self.copied is None:
            tensors = (torch.from_numpy(np.array(array, to.dtype)) for to, array in pairs)
            return _tree(world, tensors)
        self.copied.synchronize()  # the last world may still be on its way
        for buffer, array in pairs:
            np.copyto(buffer, array, casting="unsafe")
        sent = self.world.map(lambda leaf: leaf.to(self.device, non_blocking=True))
        self.copied.record()
        return sent

    def receive(self, actions: Tree) -> Tree:
        """Returns actions as arrays, once the device has chosen them. They are valid until the next
        call.
        """
        if self.copied is None:
            return spaces.map(lambda _, leaf: leaf.numpy(), self.actions, actions)
        spaces.map(lambda to, leaf: to.copy_(leaf, non_blocking=True), self.actions, actions)
        self.copied.record()
        self.copied.synchronize()
        return spaces.map(lambda leaf: leaf.numpy(), self.actions)


def _tree(like, values) -> arrdict:
    """Returns the next values of an iterator as a tree with the keys of another."""
    return arrdict(
        {
            key: _tree(child, values) if isinstance(child, dict) else next(values)
            for key, child in like.items()
        }
    )
