"""Minimal: an agent that moves and sees. N environments of one agent each, so B = N lanes."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import torch
from pydantic import Field

from megastep import engine, modules, plotting, toys
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.envs.common import SceneryEnv
from megastep.scene import scenery, spread
from megastep.settings import MAX_ENVS, checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Minimal"]


class Minimal(SceneryEnv):
    """An agent moves through a floor plan and is never rewarded: a template for other environments.

    Observation:
        (B, 1, 3, 1, ``res``) float16: the RGB image of one camera, linear light.

    Actions:
        (B, 1) integers: 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right.
        They set the velocity for one step (:class:`~megastep.modules.SimpleMovement`).

    Reward:
        Always 0.

    Episode end:
        Truncated after a random number of steps from ``shortest`` to ``longest``. Never terminal.

    Metrics:
        None.

    Args:
        n_envs: number of environments, N.
        geometries: floor plans. Default: a box of 5 m x 5 m.
        seed: of textures, lights, spawns and lifespans.
        device: where the tensors are. Default: a GPU if there is one.
        res: rays of the camera, one per pixel.
        fov: field of view, degrees.
        fps: steps per second of simulated time.
        shortest: minimum lifespan, steps.
        longest: maximum lifespan, steps.
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
        geometries = [toys.box()] if geometries is None else spread(geometries, n_envs)
        homes = scenery(geometries, n_agents=1, n_envs=n_envs, seed=seed, device=device)
        self.core = Core(homes, res, fov, fps, seed=seed)
        self.n_envs, self.device, self.fps = n_envs, self.core.device, self.core.fps
        self.spawner = modules.RandomSpawns(geometries, self.core)
        self.movement = modules.SimpleMovement(self.core)
        self.lifecycle = modules.Lifecycle(
            self.core, modules.RandomLifespans(self.core, shortest, longest)
        )
        self.obs_space = modules.RGB(self.core).space
        self.action_space = self.movement.space
        self._reward = torch.zeros(n_envs, device=self.device)
        self._resets = engine.Resets()

    def _begin(self, mask) -> arrdict:
        return self._world(mask)

    def desync(self) -> None:
        """Gives every lane a random age, from the seed, so that episodes do not end together."""
        self.lifecycle.desync()

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step by ``decision["actions"]``, (B, 1). Returns a world."""
        self.movement(decision)
        return self._resets.keep(self._world(self.lifecycle.start_ended()))

    def _world(self, reset) -> arrdict:
        self.spawner(reset)
        return arrdict(obs=self._rgb(), reward=self._reward.clone(), **self.lifecycle(reset))

    def _rgb(self) -> torch.Tensor:
        view = engine.observe(self.core.scenery, self.core.agents, depth=False)
        assert view.rgb is not None
        return view.rgb.view(self.n_envs, *self.obs_space.shape)

    def state(self, e: int = 0) -> arrdict:
        """Returns the tensors of environment ``e`` that :meth:`plot_state` draws."""
        return arrdict(
            core=self.core.state(e), rgb=self._rgb()[e], lifecycle=self.lifecycle.state(e)
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws a numpyified :meth:`state`: the floor plan above the agent's image."""
        lifecycle = state.lifecycle
        title = f"step {lifecycle.age[0]} of {lifecycle.limit[0]}"
        figure, plan, strips = plotting.panels(1, title=title)
        Core.plot_state(state.core, plan)
        modules.RGB.plot_state(state.rgb, strips)
        return figure
