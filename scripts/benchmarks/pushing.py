"""Pushing: four agents push nine boxes into the middle of a room. A game with all that a step of
training takes but the network: physics, rendering, reward, resets.
"""

from typing import Any

import torch

from megastep import engine, modules, scene, spaces, toys
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.envs.common import SceneryEnv

KINDS = {
    "box": modules.Crate(5, 0.3, movable=True),
    "plank": modules.Crate(4, 0.8, width=0.2, movable=True),
}


class Pushing(SceneryEnv):
    """Rewards all agents by the share of boxes that are within a metre of the middle."""

    def __init__(self, n_envs: int, device: torch.device, n_agents: int = 4, kinds: Any = KINDS):
        room = [toys.box(10)]
        self.core = Core(scene.scenery(room, n_agents, n_envs, device=device), res=256)
        self.n_envs, self.n_agents, self.device = n_envs, n_agents, device
        self.spawner = modules.RandomSpawns(room, self.core)
        self.movement = modules.MomentumMovement(self.core)
        self.lifecycle = modules.Lifecycle(self.core, 240)
        self.objects = modules.Objects(room, self.core, kinds)
        self.middle = self.core.scenery.layouts.extents.view(-1, 2, 2)[0].mean(0)
        self._resets = engine.Resets()
        self.action_space = spaces.MultiDiscrete(1, len(modules.MOVES))
        self.obs_space = dotdict(
            rgb=spaces.MultiImage(1, 3, 1, 64, low=0, high=1),
            d=spaces.MultiImage(1, 1, 1, 64, low=0, high=1),
            imu=spaces.MultiVector(1, 3),
        )

    def _begin(self, mask):
        begins = mask.view(self.n_envs, -1).any(1)
        return self._world(begins.repeat_interleave(self.n_agents, output_size=len(mask)))

    def step(self, decision: Any) -> arrdict:
        """Takes one step with ``decision.actions`` (B, 1). Returns a world."""
        self.movement(decision)
        return self._resets.keep(self._world(self.lifecycle.start_ended()))

    def _world(self, reset):
        self.spawner(reset)
        for kind in self.objects.kinds.values():
            kind.place(reset.view(self.n_envs, -1)[:, 0])
        near = (self.objects.all.positions - self.middle).square().sum(-1) < 1
        view = engine.observe(self.core.scenery, self.core.agents, subsample=4, imu=True)
        lanes = self.n_envs * self.n_agents
        assert view.rgb is not None and view.depth is not None and view.imu is not None
        tensors = dict(rgb=view.rgb, d=view.depth, imu=view.imu)
        return arrdict(
            obs={k: x.view(lanes, *self.obs_space[k].shape) for k, x in tensors.items()},
            reward=near.float().mean(1).repeat_interleave(self.n_agents).masked_fill(reset, 0.0),
            **self.lifecycle(reset),
        )
