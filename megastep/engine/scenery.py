"""Scenery: what the engine renders and collides with.

Walls, their textures and baked light, and lights belong to a *layout*, a floor plan as the engine
holds it; an environment shows a layout, so that a million environments share a few thousand homes.
Each environment adds only its agents' lines and the light on them.

N environments, D layouts, A agents per environment, M lines of the agent model, K texels of one
environment's agents, W walls and T texels of all layouts.
"""

from functools import cached_property
from typing import Any

import torch

from megastep.engine import checks, views
from megastep.engine.views import JoinedRagged
from megastep.kernels.build.launch import ENGINE
from megastep.ragged import Ragged
from megastep.read_only import ReadOnlyTensor, SetOnce

__all__ = ["Layouts", "Scenery"]

BOX_WALLS = ENGINE.constants["BOX_WALLS"]  # walls per bounding box


class Layouts(SetOnce):
    """The static part of scenery, shared by the environments that show it.

    Args: ``lines`` Ragged (W, 2, 2) metres, the walls by layout; ``textures`` Ragged (T, 3), one
    subarray per wall, linear light in [0, 1]; ``lights`` Ragged (l, 3) by layout, x, y, intensity;
    ``agent_textures`` (D, K, 3). TypeError or ValueError, naming the argument, if they do not fit.

    ``lines.vals``, ``textures.vals``, ``baked.vals``, ``lights.vals`` and ``agent_textures`` may be
    written in place; call ``bake`` after moving walls or lights. ``texels`` (T, 4) is the memory
    behind ``textures`` and ``baked``.
    """

    def __init__(
        self, lines: Ragged, textures: Ragged, lights: Ragged, agent_textures: Any, device: Any
    ):
        device = checks.device("device", device)
        lines = checks.ragged("lines", lines, ("W", 2, 2), device)
        textures = checks.ragged("textures", textures, ("T", 3), device)
        lights = checks.ragged("lights", lights, ("l", 3), device)
        self.n_layouts = len(lines)
        if not self.n_layouts:
            raise ValueError(
                "lines must have the walls of at least one layout, but none were given"
            )
        _same("textures", "one subarray per wall of lines", len(lines.vals), len(textures))
        _same("lights", "one subarray per layout of lines", self.n_layouts, len(lights))
        if len(textures) and int(textures.widths.min()) < 1:
            raise ValueError("textures must have at least one texel per wall, but one has none")
        self.agent_textures = checks.floats(
            "agent_textures", agent_textures, (self.n_layouts, "K", 3), device
        )
        self.lines = _of_fixed_widths("lines", lines.vals, lines.widths)
        self.lights = _of_fixed_widths("lights", lights.vals, lights.widths)
        light = torch.ones((len(textures.vals), 1), device=device)
        self.texels = torch.cat([textures.vals, light], 1)
        self.textures = _of_fixed_widths("textures", self.texels[:, :3], textures.widths)
        self.baked = _of_fixed_widths("baked", self.texels[:, 3], textures.widths)
        self.wall_starts = _starts("wall_starts", lines.widths)
        self.light_starts = _starts("light_starts", lights.widths)
        self.texel_starts = _starts("texel_starts", textures.widths)
        self.box_starts = _starts("box_starts", -(-lines.widths // BOX_WALLS))
        self.n_walls, self.n_texels, self.n_lights = (
            len(r.vals) for r in (lines, textures, lights)
        )
        self._boxes = torch.empty((int(self.box_starts[-1]), 4), device=device)
        self.update_bounding_boxes()

    def __len__(self):
        return self.n_layouts

    @property
    def boxes(self) -> torch.Tensor:
        """(b, 4) min x, min y, max x, max y around every 32 walls of a layout, which let the GPU
        skip what cannot be seen or met. Read-only.
        """
        return ReadOnlyTensor(
            self._boxes,
            "boxes are read-only: they follow the walls, so call bake after moving them",
        )

    def update_bounding_boxes(self) -> None:
        """Fits ``boxes`` to where the walls are now, in place. ``bake`` does it too."""
        layout = self.lines.inverse
        wall = torch.arange(len(layout), device=layout.device)
        box = self.box_starts.long()[layout] + (wall - self.lines.starts[layout]) // BOX_WALLS
        box, ends = box[:, None].expand(-1, 2), self.lines.vals
        self._boxes[:, :2].fill_(torch.inf).scatter_reduce_(0, box, ends.amin(1), "amin")
        self._boxes[:, 2:].fill_(-torch.inf).scatter_reduce_(0, box, ends.amax(1), "amax")

    @cached_property
    def max_texels(self) -> int:
        """The most static texels that any layout has."""
        return int(self.texel_starts[self.wall_starts.long()].diff().max())


class Scenery(SetOnce):
    """N environments of A agents each.

    ``Scenery(n_agents, lights, lines, textures, model)`` takes what every environment has of its
    own: raggeds of ``lights`` (l, 3) and ``lines`` (L, 2, 2) by environment, each one's agents'
    lines first, ``textures`` (T, 3) by line, and the agents' ``model`` (M, 2, 2) in metres about
    their origin. The agents' texture widths must be the same in every environment.
    :meth:`of_layouts` shares layouts between environments. TypeError or ValueError, naming the
    argument, if they do not fit.

    ``layout`` (N,) int32, the layout each environment shows, may be written in place; so may what
    :class:`Layouts` names. ``agent_lines`` (N, A M, 2, 2) and ``agent_light`` (N, K) are written by
    every render. ``lines``, ``lights``, ``textures`` and ``baked`` show all this by environment,
    and raise ValueError where somebody writes into them.
    """

    def __init__(
        self,
        n_agents: int,
        lights: Ragged,
        lines: Ragged,
        textures: Ragged,
        model: Any,
        device: Any = None,
    ):
        n_agents = checks.integer("n_agents", n_agents, 0)
        device = None if device is None else checks.device("device", device)
        lines = checks.ragged("lines", lines, ("L", 2, 2), device)
        device = lines.device
        textures = checks.ragged("textures", textures, ("T", 3), device)
        model = checks.floats("model", model, ("M", 2, 2), device)
        n, own = len(lines), n_agents * len(model)
        _same("textures", "one subarray per line of lines", len(lines.vals), len(textures))
        if not n or int(lines.widths.min()) < own:
            fewest = int(lines.widths.min()) if n else 0
            raise ValueError(
                f"lines must begin, in every environment, with the {own} lines of its {n_agents} "
                f"agents, but one has {fewest} lines in all"
            )
        within = torch.arange(len(lines.vals), device=device) - lines.starts[lines.inverse]
        is_agent = within < own
        agent_widths = textures.widths[is_agent].view(n, own)
        if not bool((agent_widths == agent_widths[0]).all()):
            raise ValueError(
                "textures of the agents' lines must have the same widths in every environment, but "
                "they differ"
            )
        of_agent = is_agent[textures.inverse]
        layouts = Layouts(
            Ragged(lines.vals[~is_agent], lines.widths - own),
            Ragged(textures.vals[~of_agent], textures.widths[~is_agent]),
            lights,
            textures.vals[of_agent].view(n, int(agent_widths[0].sum()), 3),
            device,
        )
        self._set(n_agents, layouts, model, agent_widths[0], torch.arange(n))

    @classmethod
    def of_layouts(
        cls, n_agents: int, layouts: Layouts, model: Any, model_widths: Any, layout: Any
    ) -> "Scenery":
        """Environments that share layouts: ``layout`` (N,) integers, the one each shows;
        ``model_widths`` (A M,) integers, the texels of each agent line.
        """
        checks.instance("layouts", layouts, Layouts)
        n_agents = checks.integer("n_agents", n_agents, 0)
        self = cls.__new__(cls)
        self._set(n_agents, layouts, model, model_widths, layout)
        return self

    def _set(self, n_agents, layouts, model, model_widths, layout):
        device = layouts.texels.device
        model = checks.floats("model", model, ("M", 2, 2), device)
        n_lines, n_texels = n_agents * len(model), layouts.agent_textures.shape[1]
        widths = checks.integers("model_widths", model_widths, n_lines, 1, 2**31 - 1, device)
        layout = checks.integers("layout", layout, "N", 0, len(layouts) - 1, device)
        _same("model_widths", "widths that add up to agent_textures'", n_texels, int(widths.sum()))
        if not len(layout):
            raise ValueError("layout must have at least one environment, but none was given")
        self.n_envs, self.n_agents, self.n_agent_texels = len(layout), n_agents, n_texels
        self.layouts, self.device = layouts, device
        self.model = _fixed("model", model.clone())
        self.model_texels = _starts("model_texels", widths)
        self.layout = layout.to(torch.int32)
        self.agent_lines = model.repeat(self.n_envs, n_agents, 1, 1)
        self.agent_light = torch.ones((self.n_envs, n_texels), device=device)
        self.reach = float(model.norm(dim=-1).max()) if len(model) else 0.0

    @property
    def lines(self) -> JoinedRagged:
        """Per environment, all its lines (l, 2, 2): the agents' first, as last rendered."""
        return views.lines(self)

    @property
    def lights(self) -> JoinedRagged:
        """Per environment, its lights (l, 3)."""
        return views.lights(self)

    @property
    def textures(self) -> JoinedRagged:
        """Per line of all environments, its texels (w, 3); line l of environment e is line
        ``lines.starts[e] + l``.
        """
        return views.textures(self)

    @property
    def baked(self) -> JoinedRagged:
        """Per line of all environments, the light on its texels (w,)."""
        return views.baked(self)

    def env(self, e: int) -> tuple[torch.Tensor, tuple[torch.Tensor, ...], torch.Tensor]:
        """Copies of environment ``e`` alone: (lines (l, 2, 2), a tuple of lit textures (w, 3) per
        line, lights (l, 3)), the agents' first. Cheap however many environments there are.
        """
        e = checks.integer("e", e, -self.n_envs, self.n_envs - 1)
        layouts, d = self.layouts, int(self.layout[e])
        lines = torch.cat([self.agent_lines[e], layouts.lines[d]])
        first, last = layouts.wall_starts[d : d + 2].tolist()
        bounds, own = layouts.texel_starts[first : last + 1].tolist(), self.model_texels.tolist()
        agents = layouts.agent_textures[d] * self.agent_light[e, :, None]
        texels = layouts.texels[bounds[0] : bounds[-1]]
        walls = texels[:, :3] * texels[:, 3:]
        return (
            lines,
            (*agents.split(_widths(own)), *walls.split(_widths(bounds))),
            layouts.lights[d].clone(),
        )


def _same(name, what, wanted, given):
    if wanted != given:
        raise ValueError(f"{name} must have {what}, so {wanted}, but {given} were given")


def _widths(bounds):
    return [last - first for first, last in zip(bounds, bounds[1:])]


def _fixed(name, tensor):
    return ReadOnlyTensor(
        tensor, f"{name} is read-only, because all else is laid out by it: make another Scenery"
    )


def _of_fixed_widths(name, vals, widths):
    return Ragged(vals, _fixed(f"{name}.widths", widths.clone()))


def _starts(name, widths):
    """(n + 1,) int32: where each subarray starts, and where the last ends."""
    ends = widths.cumsum(0)
    if len(ends) and int(ends[-1]) >= 2**31:
        raise ValueError(
            f"scenery holds at most 2,147,483,647 walls and texels of each kind, but "
            f"{int(ends[-1])} were given: use fewer layouts"
        )
    return _fixed(name, torch.cat([ends.new_zeros(1), ends]).to(torch.int32))
