"""Random actions. B lanes."""

import torch

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.types import Space, Tree, World


class RandomActions:
    """A policy that samples allowed actions uniformly: the baseline for a trained one."""

    def __init__(self, action_space: Space):
        self.action_space = action_space

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns a state that says how many lanes there are."""
        return arrdict(lane=torch.zeros(n_lanes, device=device))

    def __call__(
        self,
        world: World,
        state: Tree,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, Tree]:
        n_lanes, device = len(state["lane"]), state["lane"].device
        mask = None if world is None else world.get("mask")
        actions = spaces.random_actions(self.action_space, n_lanes, device, generator, mask)
        return arrdict(actions=actions), state
