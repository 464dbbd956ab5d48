"""Minimal: an agent that moves and sees. Nothing is rewarded; episodes end at a random lifespan.

N environments of one agent, so N lanes.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import torch
from pydantic import Field

from megastep import engine, modules, plotting, toys
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.envs.common import SceneryEnv
from megastep.scene import scenery
from megastep.settings import MAX_ENVS, checked

__all__ = ["Minimal"]


class Minimal(SceneryEnv):
    """The environment to start others from: RGB of 64 pixels, seven actions, no reward, truncated
    after a random 128 to 256 steps.

    Args: ``geometries`` to live in, boxes by default; ``res`` rays; ``fov`` degrees; ``fps`` steps
    per second; ``shortest`` and ``longest`` lifespan in steps.
    """

    n_agents = 1

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        geometries: Sequence[Any] | None = None,
        *,
        seed: int = 1,
        device: torch.device | str | None = None,
        res: Annotated[int, Field(ge=1, le=1024)] = 64,
        fov: Annotated[float, Field(gt=0, lt=180)] = 130.0,
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        shortest: Annotated[int, Field(ge=1, le=10**6)] = 128,
        longest: Annotated[int, Field(ge=1, le=10**6)] = 256,
    ):
        geometries = [toys.box()] if geometries is None else geometries[:n_envs]
        self.core = Core(
            scenery(geometries, n_agents=1, n_envs=n_envs, seed=seed, device=device),
            res=res,
            fov=fov,
            fps=fps,
            seed=seed,
        )
        self.n_envs, self.device, self.fps = n_envs, self.core.device, self.core.fps
        self.spawner = modules.RandomSpawns(geometries, self.core)
        self.movement = modules.SimpleMovement(self.core)
        self.lifecycle = modules.Lifecycle(
            self.core, modules.RandomLifespans(self.core, shortest, longest)
        )
        self.obs_space = modules.RGB(self.core).space
        self.action_space = self.movement.space
        self._reward = torch.zeros(n_envs, device=self.device)

    def reset(self) -> arrdict:
        """Starts every episode anew. Returns a world."""
        return self._world(self.lifecycle.start_all())

    def step(self, decision: Mapping) -> arrdict:
        """One step by ``decision.actions`` (B, 1). Returns a world."""
        self.movement(decision)
        return self._world(self.lifecycle.start_ended())

    def _world(self, reset):
        self.spawner(reset)
        return arrdict(obs=self._rgb(), reward=self._reward.clone(), **self.lifecycle(reset))

    def _rgb(self):
        view = engine.observe(self.core.scenery, self.core.agents, depth=False)
        return view.rgb.view(self.n_envs, *self.obs_space.shape)

    def state(self, e: int = 0) -> arrdict:
        """What :meth:`plot_state` draws of environment ``e``."""
        return arrdict(
            core=self.core.state(e), rgb=self._rgb()[e], lifecycle=self.lifecycle.state(e)
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> Any:
        """A matplotlib figure of a numpyified :meth:`state`: the plan, and what the agent sees."""
        life = state.lifecycle
        figure, plan, strips = plotting.panels(1, title=f"step {life.age[0]} of {life.limit[0]}")
        Core.plot_state(state.core, plan)
        modules.RGB.plot_state(state.rgb, strips)
        return figure
