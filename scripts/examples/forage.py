"""Forage: agents carry food to a nest. An environment with objects, written in PyTorch alone.

python train.py env=scripts.examples.forage:Forage geometry=homes seconds=60
python evaluate.py run=latest against=scripts.examples.forage:Forager
python record.py run=latest
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any

import torch
from pydantic import Field

from megastep import engine, modules, plotting, scene, spaces, toys
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.envs.common import SceneryEnv
from megastep.settings import checked

GREEN, BLUE = 0, 1  # food, nest
AHEAD, TURN_LEFT, TURN_RIGHT = 3, 5, 6  # actions


class Forager:
    """Walks to the food that it sees, or with full hands to the nest; else it wanders."""

    def __init__(self, env: Any):
        res, half = env.obs_space.rgb.shape[-1], math.tan(math.radians(env.core.fov / 2))
        slopes = half * (1 - (2 * torch.arange(res, device=env.device) + 1) / res)
        self.angles = torch.rad2deg(slopes.atan())  # of each pixel, positive to the left

    def in_lanes(self, lanes: torch.Tensor) -> "Forager":
        """Returns one that plays in some lanes: itself."""
        return self

    def initial(self, n_lanes: int, device: Any = None) -> arrdict:
        """Returns the steps (n,) that it goes on turning away from a wall, and to which side."""
        return arrdict(turns=torch.zeros(n_lanes, dtype=torch.int64, device=device))

    def __call__(self, world, state, sample=True, generator=None):
        """Returns (decision, next state)."""
        obs = world["obs"]
        red, green, blue = obs["rgb"][:, 0, :, 0].float().unbind(1)  # (n, P) each
        wanted = torch.where(obs["carrying"][:, 0] > 0, blue - green, green - blue) - red
        seen, pixel = wanted.max(-1)
        depth = obs["d"][:, 0, 0, 0].float()
        ahead = depth[:, len(self.angles) // 4 : -len(self.angles) // 4].amax(-1)
        side = torch.where(depth[:, :16].mean(-1) < depth[:, -16:].mean(-1), 8, -8)
        step = state["turns"].sign()
        turns = torch.where((ahead > 0.96) & (step == 0), side, state["turns"] - step)
        goal = torch.where(seen > 0.15, self.angles[pixel], 60.0 * turns.sign())
        error = 2 * goal - 360 * obs["imu"][:, 0, 0].float()  # degrees per second
        action = torch.where(error > 20, TURN_LEFT, torch.where(error < -20, TURN_RIGHT, AHEAD))
        return arrdict(actions=action[:, None]), arrdict(turns=turns)


class Forage(SceneryEnv):
    """Rewards 1 for each piece of food carried to the nest. Food grows back elsewhere.

    Observation: ``rgb`` and ``d``, images of one camera; ``imu``; ``carrying``, 1 with full hands.
    Metrics: ``food``, pieces carried home by all agents.
    """

    bot = Forager

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=10**6)] = 128,
        geometries: Sequence[Any] | None = None,
        *,
        n_agents: Annotated[int, Field(ge=1, le=8)] = 2,
        food: Annotated[int, Field(ge=1, le=64)] = 6,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 500,
        seed: int = 1,
        device: torch.device | str | None = None,
    ):
        geometries = [toys.box()] if geometries is None else scene.spread(geometries, n_envs)
        homes = scene.scenery(geometries, n_agents, n_envs, seed=seed, device=device)
        self.core = Core(homes, res=256, seed=seed)
        self.n_envs, self.n_agents, self.device = n_envs, n_agents, self.core.device
        self.spawner = modules.RandomSpawns(geometries, self.core)
        self.movement = modules.MomentumMovement(self.core)
        self.lifecycle = modules.Lifecycle(self.core, limit)
        kinds = {"food": food, "nest": modules.Disc(1, radius=0.3)}
        self.objects = modules.Objects(geometries, self.core, kinds, colours=("green", "blue"))
        self.food, self.nest = self.objects["food"], self.objects["nest"]
        self._resets = engine.Resets()
        self.carried_home = torch.zeros(n_envs, device=self.device)
        self.action_space = spaces.MultiDiscrete(1, len(modules.MOVES))
        self.obs_space = dotdict(
            rgb=spaces.MultiImage(1, 3, 1, 64, low=0, high=1),
            d=spaces.MultiImage(1, 1, 1, 64, low=0, high=1),
            imu=spaces.MultiVector(1, 3),
            carrying=spaces.MultiVector(1, 1, low=0, high=1),
        )

    def _begin(self, mask):
        begins = mask.view(self.n_envs, -1).any(1)
        # nothing keeps clear of what lay about in the last episode, so a seed gives the same places
        self.objects.all.visible.masked_fill_(begins[:, None], False)
        return self._world(begins.repeat_interleave(self.n_agents, output_size=len(mask)))

    def step(self, decision: Any) -> arrdict:
        """Takes one step with ``decision.actions`` (B, 1). Returns a world."""
        self.movement(decision)
        return self._resets.keep(self._world(self.lifecycle.start_ended()))

    def _world(self, reset):
        begins = reset.view(self.n_envs, -1)[:, 0]  # all agents of an environment begin together
        self.spawner(reset)
        self.nest.place(begins, BLUE)
        self.food.place(begins, GREEN)

        home = self.food.carried() & self.nest.touching()  # (N, A, K)
        self.food.place(home.any(1))
        near = self.food.touching() & ~self.food.carried().any(-1, keepdim=True)
        self.food.carry(near & (near.cumsum(-1) == 1))  # one piece at a time

        paid = home.any(-1).float()
        self.carried_home.add_(paid.sum(1)).masked_fill_(begins, 0)
        return arrdict(
            obs=self._observe(),
            reward=paid.flatten().masked_fill(reset, 0.0),
            metrics=arrdict(food=self.carried_home.repeat_interleave(self.n_agents)),
            **self.lifecycle(reset),
        )

    def _observe(self):
        view = engine.observe(self.core.scenery, self.core.agents, subsample=4, imu=True)
        carrying = self.food.carried().any(-1).float()
        tensors = dict(rgb=view.rgb, d=view.depth, imu=view.imu, carrying=carrying)
        lanes, space = self.n_envs * self.n_agents, self.obs_space
        return arrdict({key: x.view(lanes, *space[key].shape) for key, x in tensors.items()})

    def state(self, e: int = 0) -> arrdict:
        """Returns what :meth:`plot_state` draws of environment ``e``."""
        rgb = self._observe().rgb.view(self.n_envs, self.n_agents, 3, 1, -1)[e]
        return arrdict(core=self.core.state(e), rgb=rgb, home=self.carried_home[e].clone())

    @classmethod
    def plot_state(cls, state: arrdict) -> Any:
        """Draws a numpyified :meth:`state`: the plan, and what each agent sees."""
        title = f"{int(state.home)} carried home"
        figure, plan, strips = plotting.panels(len(state.rgb), title=title)
        Core.plot_state(state.core, plan)
        modules.RGB.plot_state(state.rgb, strips)
        return figure
