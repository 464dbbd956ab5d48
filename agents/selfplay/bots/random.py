"""Random actions. B lanes."""

from collections.abc import Mapping

import torch

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.types import Space


class RandomActions:
    """A policy that samples actions uniformly: the baseline for a trained one."""

    def __init__(self, action_space: Space):
        self.action_space = action_space

    def initial(self, n_lanes: int, device: torch.device | str) -> arrdict:
        """Returns a state that says how many lanes there are."""
        return arrdict(lane=torch.zeros(n_lanes, device=device))

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, Mapping]:
        n_lanes, device = len(state["lane"]), state["lane"].device

        def draw(space):
            return spaces.random_actions(space, n_lanes, device, generator)

        return arrdict(actions=spaces.map(draw, self.action_space)), state
