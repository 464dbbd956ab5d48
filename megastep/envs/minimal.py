"""Minimal: an agent that moves and sees. Nothing is rewarded; episodes end at a random lifespan."""

import torch

from .. import engine, modules, plotting, toys
from ..arrdict import arrdict
from ..core import Core
from ..scene import scenery


class Minimal:
    """Seed of every other environment: RGB of 64 pixels, seven actions, no reward, truncated after
    a random 128 to 256 steps.

    Args: ``geometries`` to live in, boxes by default; ``res`` rays; ``fov`` degrees; ``shortest``
    and ``longest`` lifespan in steps.
    """

    n_agents = 1

    def __init__(
        self,
        n_envs=128,
        geometries=None,
        *,
        seed=1,
        device=None,
        res=64,
        fov=130.0,
        fps=10.0,
        shortest=128,
        longest=256,
    ):
        geometries = [toys.box()] if geometries is None else geometries[:n_envs]
        self.core = Core(
            scenery(geometries, n_agents=1, n_envs=n_envs, seed=seed, device=device),
            res=res,
            fov=fov,
            fps=fps,
            seed=seed,
        )
        self.n_envs, self.device = self.core.n_envs, self.core.device
        self.spawner = modules.RandomSpawns(geometries, self.core)
        self.lifespans = modules.RandomLifespans(self.core, shortest, longest)
        self.movement = modules.SimpleMovement(self.core)
        self.obs_space = modules.RGB(self.core).space
        self.action_space = self.movement.space
        self.ended = torch.zeros(n_envs, dtype=torch.bool, device=self.device)
        self._reward = torch.zeros(n_envs, device=self.device)

    def reset(self):
        """Starts every episode anew. Returns a world."""
        return self._observe(torch.ones_like(self.ended))

    def step(self, decision):
        """One step by ``decision.actions`` (B, 1). Returns a world."""
        self.movement(decision)
        return self._observe(self.ended.clone())

    def _observe(self, reset):
        self.spawner(reset)
        self.ended.copy_(self.lifespans(reset) & ~reset)
        return arrdict(
            obs=self._look(),
            reward=self._reward.clone(),
            reset=reset,
            terminal=torch.zeros_like(reset),
            truncated=self.ended.clone(),
        )

    def _look(self):
        view = engine.observe(self.core.scenery, self.core.agents, depth=False)
        return view.rgb.view(self.n_envs, *self.obs_space.shape)

    @property
    def layout(self) -> torch.Tensor:
        """(N,) int32: the layout that each environment shows now, an index into ``geometries``."""
        return self.core.scenery.layout

    def state(self, e=0):
        """What :meth:`plot_state` draws of world ``e``."""
        return arrdict(
            core=self.core.state(e), obs=self._look()[e], lifespans=self.lifespans.state(e)
        )

    @classmethod
    def plot_state(cls, state):
        """A matplotlib figure of a numpyified :meth:`state`: the plan, and what the agent sees."""
        figure, plan, strips = plotting.panels(
            1, title=f"step {state.lifespans.age} of {state.lifespans.lifespan}"
        )
        Core.plot_state(state.core, plan)
        plotting.plot_images({"rgb": state.obs}, aspect=plotting.STRIP, axes=strips)
        return figure
