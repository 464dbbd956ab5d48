"""Core: scenery, agents and camera settings in one object."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from megastep import engine
from megastep.arrdict import arrdict
from megastep.colour import gamma_decode, gamma_encode
from megastep.engine import checks
from megastep.engine.agents import AGENT_RADIUS, AGENT_WIDTH
from megastep.scene import TEXEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["AGENT_RADIUS", "AGENT_WIDTH", "TEXEL", "Core", "gamma_decode", "gamma_encode"]


class Core:
    """The object that an environment is built around.

    Args:
        scenery: what is rendered and collided with.
        res: rays per camera.
        fov: field of view in degrees.
        fps: steps per second.
        cameras: yaw offset of each camera in degrees. Default: one camera, straight ahead.
        seed: default seed of the modules built on this core.

    Attributes:
        agents: the :class:`~megastep.engine.Agents`.
        n_envs, n_agents, device: those of the scenery.
        scenery, res, fov, fps, seed: the arguments.
    """

    def __init__(
        self,
        scenery: engine.Scenery,
        res: int = 64,
        fov: float = 130.0,
        fps: float = 10.0,
        cameras: Sequence[float] | None = None,
        seed: int = 1,
    ):
        self.scenery = checks.instance("scenery", scenery, engine.Scenery)
        self.seed = checks.integer("seed", seed, 0)
        self.n_envs, self.n_agents, self.device = scenery.n_envs, scenery.n_agents, scenery.device
        self.agents = engine.Agents(
            self.n_envs,
            self.n_agents,
            res=res,
            fov=fov,
            fps=fps,
            cameras=cameras,
            device=self.device,
        )
        self.res, self.fov, self.fps = self.agents.res, self.agents.fov, self.agents.fps

    def agent_full(self, value: float) -> torch.Tensor:
        """Returns an (N, A) tensor filled with ``value``, of the dtype that suits it."""
        return torch.full((self.n_envs, self.n_agents), value, device=self.device)

    def env_full(self, value: float) -> torch.Tensor:
        """Returns an (N,) tensor filled with ``value``, of the dtype that suits it."""
        return torch.full((self.n_envs,), value, device=self.device)

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`: lines of agents, objects and walls, lit
        texels, lights, agents' poses.
        """
        engine.update_agent_geometry(self.scenery, self.agents)
        engine.update_objects(self.scenery, self.agents)
        lines, colours, lights = self.scenery.env(e)
        agents, n_moving = self.agents, self.scenery.agent_lines.shape[1]
        if self.scenery.objects is not None:  # without those that are not there
            n_agent_lines, n_moving = n_moving, n_moving + self.scenery.objects.lines.shape[1]
            kept = (lines[:, 0] != lines[:, 1]).any(-1).tolist()
            kept = [
                k for k, is_long in enumerate(kept) if is_long or not n_agent_lines <= k < n_moving
            ]
            n_moving -= len(lines) - len(kept)
            lines, colours = lines[kept], [colours[k] for k in kept]
        return arrdict(
            lines=lines,
            texels=torch.cat(colours),
            widths=torch.tensor([len(texels) for texels in colours]),
            lights=lights,
            n_moving_lines=torch.tensor(n_moving),
            positions=agents.positions[e].clone(),
            angles=agents.angles[e].clone(),
            yaws=agents.yaws.clone(),
            fov=torch.tensor(agents.fov),
        )

    @staticmethod
    def plot_state(
        state: arrdict,
        ax: "Axes | None" = None,
        seen: np.ndarray | None = None,
        distances: np.ndarray | None = None,
    ) -> "Axes":
        """Draws a numpyified :meth:`state` from above, with each camera's field of view.

        Args:
            state: from :meth:`state`, as numpy arrays.
            ax: matplotlib axes to draw on. Default: new ones.
            seen: (T,) bool; static texels that are False are dimmed.
            distances: (A, C, R) metres; draws what each camera sees instead of a wedge.

        Returns:
            The axes.
        """
        from megastep import plotting

        ends = state.widths.cumsum()
        colours = np.split(state.texels, ends[:-1])
        parts = None
        if seen is not None:
            n_moving = int(state.widths[: int(state.n_moving_lines)].sum())
            parts = np.split(np.concatenate([np.ones(n_moving, bool), seen]), ends[:-1])
        ax = plotting.plot_scenery(state.lines, colours, state.lights, seen=parts, ax=ax)
        marks = plotting.camera_colours(len(state.yaws))
        for a, (position, angle) in enumerate(zip(state.positions, state.angles, strict=True)):
            for c, (yaw, mark) in enumerate(zip(state.yaws, marks, strict=True)):
                in_view = None if distances is None else distances[a, c]
                plotting.plot_view(
                    ax, position, angle + yaw, float(state.fov), in_view, colour=mark
                )
            if len(state.positions) > 1:
                ax.annotate(str(a), position, (4, 4), textcoords="offset points", color="w")
        return ax
