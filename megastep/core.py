"""Core: scenery, agents and camera settings in one object."""

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from megastep import engine
from megastep.arrdict import arrdict
from megastep.colour import gamma_decode, gamma_encode
from megastep.engine import checks
from megastep.engine.agents import AGENT_RADIUS, AGENT_WIDTH
from megastep.engine.objects import NUMBERS
from megastep.scene import TEXEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from megastep.plotting import Area

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
        radius: of the agents, in metres.

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
        radius: float = AGENT_RADIUS,
    ):
        self.scenery = checks.instance("scenery", scenery, engine.Scenery)
        self.seed = checks.integer("seed", seed, 0)
        self.n_envs, self.n_agents, self.device = scenery.n_envs, scenery.n_agents, scenery.device
        size = self.n_envs, self.n_agents
        self.agents = engine.Agents(*size, res, fov, fps, cameras, radius, self.device)
        self.res, self.fov, self.fps = self.agents.res, self.agents.fov, self.agents.fps

    def agent_full(self, value: float) -> torch.Tensor:
        """Returns an (N, A) tensor filled with ``value``, of the dtype that suits it."""
        return torch.full((self.n_envs, self.n_agents), value, device=self.device)

    def env_full(self, value: float) -> torch.Tensor:
        """Returns an (N,) tensor filled with ``value``, of the dtype that suits it."""
        return torch.full((self.n_envs,), value, device=self.device)

    def alone(self, e: int) -> "Core":
        """Returns a copy of environment ``e`` as the only one of a core that shares its layouts."""
        shared = self.scenery
        widths, layout = shared.model_texels.diff(), shared.layout[[e]]
        scenery = engine.Scenery(self.n_agents, shared.layouts, shared.model, widths, layout)
        if shared.objects is not None:
            objects = copy.copy(shared.objects)
            own = {
                name: getattr(objects, name)[[e]]
                for name in ("records", "lines", "texels", "bodies")
            }
            vars(objects).update(own, n_envs=1)
            scenery.objects = objects
        yaws = self.agents.yaws.tolist()
        one = Core(scenery, self.res, self.fov, self.fps, yaws, self.seed, self.agents.radius)
        for name in ("positions", "angles", "velocity", "angvelocity"):
            getattr(one.agents, name).copy_(getattr(self.agents, name)[[e]])
        return one

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`: walls and their lit texels, lights,
        agents' poses and how far their cameras see, objects. A film adds ``trail``, (T, A, 2), and
        ``views``, (T, A, C, R + 1, 2); see :func:`megastep.recording.film`. An environment may add
        ``teams``, (A,) integers, by which agents are coloured then.
        """
        core = self.alone(e)
        agents, scenery, objects = core.agents, core.scenery, core.scenery.objects
        engine.update_objects(scenery, agents)
        lines, colours, lights = scenery.env(0)
        n_moving = scenery.agent_lines.shape[1]
        if objects is not None:
            n_moving += objects.lines.shape[1]
        depth = engine.observe(scenery, agents, rgb=False).depth
        assert depth is not None
        state = arrdict(
            lines=lines[n_moving:],
            texels=torch.cat([colours[0][:0], *colours[n_moving:]]),
            widths=torch.tensor([len(texels) for texels in colours[n_moving:]], dtype=torch.int64),
            lights=lights,
            positions=agents.positions[0].clone(),
            angles=agents.angles[0].clone(),
            yaws=agents.yaws.clone(),
            fov=torch.tensor(agents.fov),
            radius=torch.tensor(agents.radius),
            distances=(agents.radius + 10 * (1 - depth[0].float())).view(
                self.n_agents, len(agents.yaws), -1
            ),
        )
        if objects is not None:
            there = objects.visible[0] & ~objects.open[0]
            state["objects"] = arrdict(
                shapes=objects.shapes[there],
                positions=objects.positions[0][there],
                angles=objects.angles[0][there],
                sizes=objects.sizes[0][there],
                widths=objects.widths[there],
                colours=objects.palette[objects.colours[0][there].long()],
            )
            if objects.n_bodies:
                body = objects.object_bodies[there].long()
                for name in ("holders", "owners"):  # -1 of what is no body, too
                    values = torch.where(body < 0, -1, getattr(objects, name)[0][body])
                    state["objects"][name] = values
        return state

    @staticmethod
    def plot_state(
        state: arrdict, ax: "Area | Axes | None" = None, seen: np.ndarray | None = None
    ) -> "Area | Axes":
        """Draws a numpyified :meth:`state` from above: rooms, walls, objects, agents in their
        colours with what they see and a line to what they hold, and in films where they were. What
        a team locked has an outline in its colour. Returns what it is drawn on.

        Args:
            state: from :meth:`state`, as numpy arrays.
            ax: an area of :func:`megastep.plotting.panels`, or matplotlib axes. Default: new axes.
            seen: (T,) bool, wall texels that count as seen. The others are grey, and floor that no
                agent saw is hatched in films.
        """
        from megastep import plotting

        split = state.widths.cumsum()[:-1]
        trail, views = state.get("trail"), state.get("views")
        of_walls = None if seen is None else np.split(seen, split)
        if views is not None:
            views = None if seen is None else views.reshape(-1, *views.shape[-2:])
        texels = np.split(state.texels, split)
        drawn_on = plotting.plot_scenery(state.lines, texels, state.lights, of_walls, ax, views)
        area = plotting.Area.on(drawn_on)
        objects, names = (
            state.get("objects", arrdict(shapes=())),
            {n: s for s, n in NUMBERS.items()},
        )
        n_agents, n_cameras = len(state.positions), len(state.yaws)
        palette, n_colours = plotting.AGENTS, len(plotting.AGENTS)
        teams = state.get("teams", np.arange(n_agents)) % n_colours
        nobody = np.full(len(objects.shapes), -1)
        owners, holders = (objects.get(name, nobody) for name in ("owners", "holders"))
        for k, shape in enumerate(objects.shapes):
            pose = objects.positions[k], objects.angles[k], objects.sizes[k]
            colour, width = gamma_encode(objects.colours[k]), float(objects.widths[k])
            edge = None if owners[k] < 0 else palette[owners[k] % n_colours]
            plotting.plot_object(area, names[int(shape)], *pose, colour, width, edge)
            if holders[k] >= 0:
                start, team = state.positions[holders[k]], teams[holders[k]]
                plotting.plot_hold(area, start, objects.positions[k], palette[team])
        for a, (position, angle) in enumerate(zip(state.positions, state.angles, strict=True)):
            colour = palette[teams[a]]
            of_cameras = [colour] if n_cameras == 1 else plotting.camera_colours(n_cameras)
            for c, (yaw, mark) in enumerate(zip(state.yaws, of_cameras, strict=True)):
                plotting.plot_view(
                    area, position, angle + yaw, state.fov, state.distances[a, c], colour=mark
                )
            if trail is not None:
                plotting.plot_trail(area, trail[:, a], colour)
            label = str(a) if n_agents > 1 else ""
            plotting.plot_agent(area, position, angle, state.radius, colour, label)
        return drawn_on
