"""Scenery: what the engine renders and what agents collide with.

A *layout* is a floor plan as the engine holds it: walls, their textures and baked light, and
lights. Each environment shows one, so a million environments can share a few thousand homes, and
holds only its agents' lines and the light on them.

N environments, D layouts, A agents per environment, M lines of the agent model, K texels of one
environment's agents, W walls and T texels of all layouts.
"""

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import torch

from megastep.engine import checks
from megastep.engine.objects import Objects
from megastep.kernels.build.launch import ENGINE
from megastep.ragged import Ragged, RaggedTorch
from megastep.read_only import ReadOnlyTensor, SetOnce

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

BOX_WALLS = ENGINE.constants["BOX_WALLS"]  # walls per bounding box


class Layouts(SetOnce):
    """The static part of scenery: the floor plans that environments share. ``lines.vals``,
    ``textures.vals``, ``baked.vals``, ``lights.vals`` and ``agent_textures`` may be written in
    place. Call :func:`~megastep.engine.bake` after moving walls or lights. Raises TypeError,
    ValueError naming the argument that does not fit.

    Args:
        lines: Ragged (W, 2, 2) metres, the walls of each layout.
        textures: Ragged (T, 3), linear light in [0, 1], the texels of each wall.
        lights: Ragged (l, 3), the lights of each layout: x, y, intensity.
        agent_textures: (D, K, 3), the texels of an environment's agents.
        device: where to put them.

    Attributes:
        baked: Ragged (T,), the light on each texel.
        texels: (T, 4), the memory that ``textures`` and ``baked`` share.
    """

    def __init__(
        self,
        lines: Ragged,
        textures: Ragged,
        lights: Ragged,
        agent_textures: "ArrayLike",
        device: torch.device,
    ):
        device = checks.device("device", device)
        lines = checks.ragged("lines", lines, ("W", 2, 2), device)
        textures = checks.ragged("textures", textures, ("T", 3), device)
        lights = checks.ragged("lights", lights, ("l", 3), device)
        self.n_layouts = len(lines)
        if not self.n_layouts:
            raise ValueError("lines must have at least one layout, but none was given")
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

    def __len__(self) -> int:
        return self.n_layouts

    @property
    def boxes(self) -> torch.Tensor:
        """(b, 4) bounding boxes of every 32 walls of a layout: min x, min y, max x, max y."""
        refusal = "boxes are read-only: they follow the walls, so call bake after moving them"
        return ReadOnlyTensor(self._boxes, refusal)

    def update_bounding_boxes(self) -> None:
        """Refits ``boxes`` to the walls, in place. ``bake`` calls it."""
        layout = self.lines.inverse
        wall = torch.arange(len(layout), device=layout.device)
        box = self.box_starts.long()[layout] + (wall - self.lines.starts[layout]) // BOX_WALLS
        box, ends = box[:, None].expand(-1, 2), self.lines.vals
        self._boxes[:, :2].fill_(torch.inf).scatter_reduce_(0, box, ends.amin(1), "amin")
        self._boxes[:, 2:].fill_(-torch.inf).scatter_reduce_(0, box, ends.amax(1), "amax")

    @cached_property
    def extents(self) -> torch.Tensor:
        """(D, 4): min x, min y, max x, max y of each layout's walls as they were at first."""
        layout = torch.repeat_interleave(
            torch.arange(self.n_layouts, device=self._boxes.device), self.box_starts.long().diff()
        )[:, None].expand(-1, 2)
        extents = self._boxes.new_full((self.n_layouts, 4), torch.inf)
        extents[:, 2:] = -torch.inf
        extents[:, :2].scatter_reduce_(0, layout, self._boxes[:, :2], "amin")
        extents[:, 2:].scatter_reduce_(0, layout, self._boxes[:, 2:], "amax")
        return extents

    @cached_property
    def max_texels(self) -> int:
        """The largest number of static texels in any layout."""
        return int(self.texel_starts[self.wall_starts.long()].diff().max())


class Scenery(SetOnce):
    """The scenery of N environments with A agents each, which share layouts.
    :func:`megastep.scene.scenery` makes it from geometries. TypeError or ValueError name the
    argument that does not fit.

    Args:
        n_agents: agents per environment A.
        layouts: the floor plans. May be written in place.
        model: (M, 2, 2) metres, the lines of an agent about its origin.
        model_widths: (A M,) integers, the number of texels of each agent line.
        layout: (N,) integers, the layout that each environment shows; kept as int32, which may be
            written in place.

    Attributes:
        agent_lines: (N, A M, 2, 2), written by every render.
        agent_light: (N, K), written by every render.
        objects: :class:`~megastep.engine.Objects`, or None; may be set once.
    """

    objects: Objects | None = None

    def __init__(
        self,
        n_agents: int,
        layouts: Layouts,
        model: "ArrayLike",
        model_widths: "ArrayLike",
        layout: "ArrayLike",
    ):
        checks.instance("layouts", layouts, Layouts)
        n_agents = checks.integer("n_agents", n_agents, 0)
        device = layouts.texels.device
        model = checks.floats("model", model, ("M", 2, 2), device)
        widths, layout = (
            torch.as_tensor(integers, dtype=torch.int64, device=device)
            for integers in (model_widths, layout)
        )
        n_lines, n_texels = n_agents * len(model), layouts.agent_textures.shape[1]
        _same("model_widths", "a number per line of agents", n_lines, len(widths))
        _same("model_widths", "widths that add up to agent_textures'", n_texels, int(widths.sum()))
        self.n_envs, self.n_agents, self.n_agent_texels = len(layout), n_agents, n_texels
        self.layouts, self.device = layouts, device
        self.model = _fixed("model", model.clone())
        self.model_texels = _starts("model_texels", widths)
        self.layout = layout.to(torch.int32)
        self.agent_lines = model.repeat(self.n_envs, n_agents, 1, 1)
        self.agent_light = torch.ones((self.n_envs, n_texels), device=device)
        self.reach = float(model.norm(dim=-1).max()) if len(model) else 0.0

    @property
    def lines(self) -> RaggedTorch:
        """The lines (l, 2, 2) of each environment, agents' first, as last rendered. Read-only."""
        cure = ", and call bake; agents' lines follow agents.positions at each render"
        return self._joined("lines", cure, lambda part: (part.lines, len(part.lines)))

    @property
    def lights(self) -> RaggedTorch:
        """The lights (l, 3) of each environment. Read-only."""
        return self._joined(
            "lights", ", and call bake", lambda part: (part.lights, len(part.lights))
        )

    @property
    def textures(self) -> RaggedTorch:
        """The texels (w, 3) of lines; l of environment e at ``lines.starts[e] + l``. Read-only."""
        cure = "; agents' are in scenery.layouts.agent_textures"
        return self._joined("textures", cure, lambda part: (part.texels[:, :3], part.widths))

    @property
    def baked(self) -> RaggedTorch:
        """The light (w,) on each line of all environments, indexed as ``textures``. Read-only."""
        cure = "; agents' light is computed at each render"
        return self._joined("baked", cure, lambda part: (part.texels[:, 3], part.widths))

    def env(self, e: int) -> tuple[torch.Tensor, tuple[torch.Tensor, ...], torch.Tensor]:
        """Returns copies of one environment's lines (l, 2, 2), agents' first, then objects', then
        walls; a lit texture (w, 3) of each; and lights (l, 3). Takes the same time however many
        environments there are.
        """
        e = checks.integer("e", e, -self.n_envs, self.n_envs - 1)
        part = self._part(e, int(self.layout[e]))
        lit = part.texels[:, :3] * part.texels[:, 3:]
        return part.lines, lit.split(part.widths.tolist()), part.lights.clone()

    def _part(self, e, d) -> "_Part":
        layouts, objects = self.layouts, self.objects
        first, last = layouts.wall_starts[d : d + 2].tolist()
        bounds = layouts.texel_starts[first : last + 1]
        begin, end = bounds[[0, -1]].tolist()
        light = self.agent_light[e, :, None]
        lines, widths = [self.agent_lines[e]], [self.model_texels.diff()]
        texels = [torch.cat([layouts.agent_textures[d], light], 1)]
        if objects is not None:
            lines.append(objects.lines[e])
            texels.append(objects.texels[e, objects.line_object.long()])
            widths.append(torch.ones_like(objects.line_object))
        return _Part(
            torch.cat([*lines, layouts.lines.vals[first:last]]),
            torch.cat([*texels, layouts.texels[begin:end]]),
            torch.cat([*widths, bounds.diff()]),
            layouts.lights.vals[slice(*layouts.light_starts[d : d + 2].tolist())],
        )

    def _joined(self, name: str, cure: str, pick: "Callable[[_Part], tuple]") -> RaggedTorch:
        """Returns a read-only copy of what ``pick`` takes of each environment: values, widths."""
        refusal = (
            f"scenery.{name} is a read-only copy: write into scenery.layouts.{name}, which reaches "
            f"every environment that shows the layout{cure}"
        )
        parts = (self._part(e, d) for e, d in enumerate(self.layout.tolist()))
        vals, widths = zip(*map(pick, parts))
        width = torch.cat([torch.as_tensor(one, device=self.device).view(-1) for one in widths])
        return RaggedTorch(*(ReadOnlyTensor(x, refusal) for x in (torch.cat(vals), width.long())))


class _Part(NamedTuple):
    """One environment's part of a scenery."""

    lines: torch.Tensor  # (l, 2, 2): its agents', its objects', walls
    texels: torch.Tensor  # (w, 4), line by line, with their light
    widths: torch.Tensor  # (l,) integers, texels of each line
    lights: torch.Tensor  # (k, 3)


def _same(name, what, expected, actual) -> None:
    if expected != actual:
        raise ValueError(f"{name} must have {what}, so {expected}, but {actual} were given")


def _fixed(name, tensor) -> torch.Tensor:
    return ReadOnlyTensor(
        tensor, f"{name} is read-only, because other tensors depend on it: make another Scenery"
    )


def _of_fixed_widths(name, vals, widths) -> RaggedTorch:
    return RaggedTorch(vals, _fixed(f"{name}.widths", widths.clone()))


def _starts(name, widths) -> torch.Tensor:
    """Returns (n + 1,) int32, the start of each subarray and the end of the last one."""
    ends = widths.cumsum(0)
    if len(ends) and int(ends[-1]) >= 2**31:
        raise ValueError(
            f"scenery holds at most 2,147,483,647 walls and texels of each kind, but "
            f"{int(ends[-1])} were given: use fewer layouts"
        )
    return _fixed(name, torch.cat([ends.new_zeros(1), ends]).int())
