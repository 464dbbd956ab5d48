"""Scenery by environment: read-only views that join its agents, its objects and its layout.

N environments, A agents per environment, M lines of the agent model, K texels of one environment's
agents, W walls of all layouts, L lines of all environments.
"""

from functools import cached_property

import torch

from megastep.ragged import Ragged, RaggedNumpy, RaggedTorch
from megastep.read_only import ReadOnlyTensor

__all__ = ["JoinedRagged", "baked", "lights", "lines", "textures"]

_SHARED = "which reaches every environment that shows the layout"
LINES = (
    "scenery.lines is a read-only copy: write walls into scenery.layouts.lines, "
    f"{_SHARED}, and call bake; agents' lines follow agents.positions at each render"
)
LIGHTS = (
    "scenery.lights is a read-only copy: write into scenery.layouts.lights, "
    f"{_SHARED}, and call bake"
)
TEXTURES = (
    "scenery.textures is a read-only copy: write walls' into scenery.layouts.textures and agents' "
    f"into scenery.layouts.agent_textures, {_SHARED}"
)
BAKED = (
    "scenery.baked is a read-only copy: write walls' light into scenery.layouts.baked, "
    f"{_SHARED}; agents' light is computed at each render"
)


class JoinedRagged(RaggedTorch):
    """A read-only Ragged whose subarrays join pieces of several tensors, computed when read.

    Args:
        refusal: message of the ValueError that a write raises.
        parts: (vals (V, ...), starts (D,), widths (D,)) each: the tensor, and the pieces of it.
    """

    def __init__(self, refusal: str, *parts: tuple[torch.Tensor, torch.Tensor, torch.Tensor]):
        self._message, self._parts = refusal, parts
        self.widths = self._guarded(sum(widths for _, _, widths in parts))

    def _guarded(self, tensor) -> torch.Tensor:
        return ReadOnlyTensor(tensor, self._message)

    @cached_property
    def vals(self) -> torch.Tensor:
        """(V, ...) a copy of all subarrays, concatenated."""
        vals, starts, widths = zip(*self._parts)
        lengths = torch.tensor([0, *map(len, vals)])
        starts = torch.stack([s + int(before) for s, before in zip(starts, lengths.cumsum(0))], 1)
        return self._guarded(
            torch.cat(vals)[_ranges(starts.flatten(), torch.stack(widths, 1).flatten())]
        )

    @cached_property
    def ends(self) -> torch.Tensor:
        return self._guarded(self.widths.cumsum(0))

    @cached_property
    def starts(self) -> torch.Tensor:
        return self._guarded(self.ends - self.widths)

    @cached_property
    def inverse(self) -> torch.Tensor:
        subarrays = torch.arange(len(self), device=self.device)
        return self._guarded(torch.repeat_interleave(subarrays, self.widths))

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self._parts[0][0].device

    def __getitem__(self, index: int | slice) -> torch.Tensor | Ragged:
        if isinstance(index, slice):
            indices = range(len(self))[index]
            pieces = [self._subarray(i) for i in indices] or [self._parts[0][0][:0]]
            return Ragged(
                self._guarded(torch.cat(pieces)), self._guarded(self.widths[list(indices)])
            )
        return self._guarded(self._subarray(self._index(index)))

    def _subarray(self, i: int) -> torch.Tensor:
        pieces = [vals[int(s[i]) : int(s[i]) + int(w[i])] for vals, s, w in self._parts]
        return torch.cat(pieces)

    def numpyify(self) -> RaggedNumpy:
        """Returns a writable copy with numpy arrays."""
        return self.clone().numpyify()


def _ranges(starts, widths) -> torch.Tensor:
    """Returns the indices of the ranges [start, start + width), concatenated."""
    offsets = widths.cumsum(0) - widths
    return torch.arange(int(widths.sum()), device=widths.device) + torch.repeat_interleave(
        starts - offsets, widths
    )


def lines(scenery) -> JoinedRagged:
    """Returns the lines (l, 2, 2) of each environment as last rendered: its agents', then its
    objects', then walls.
    """
    layout, walls = scenery.layout.long(), scenery.layouts.lines
    moving = [scenery.agent_lines, *([scenery.objects.lines] if scenery.objects else [])]
    e = torch.arange(scenery.n_envs, device=scenery.device)
    return JoinedRagged(
        LINES,
        *((x.flatten(0, 1), e * x.shape[1], torch.full_like(e, x.shape[1])) for x in moving),
        (walls.vals, walls.starts[layout], walls.widths[layout]),
    )


def lights(scenery) -> JoinedRagged:
    """Returns the lights (l, 3) of each environment."""
    layout, lights = scenery.layout.long(), scenery.layouts.lights
    return JoinedRagged(LIGHTS, (lights.vals, lights.starts[layout], lights.widths[layout]))


def textures(scenery) -> JoinedRagged:
    """Returns the texels (w, 3) of each line of all environments."""
    agents = scenery.layouts.agent_textures
    starts = scenery.layout.long() * agents.shape[1]
    texels = scenery.layouts.textures.vals
    return _by_line(scenery, TEXTURES, agents.flatten(0, 1), starts, texels, slice(3))


def baked(scenery) -> JoinedRagged:
    """Returns the light (w,) on each line of all environments."""
    agents = scenery.agent_light
    starts = torch.arange(scenery.n_envs, device=scenery.device) * agents.shape[1]
    return _by_line(scenery, BAKED, agents.flatten(), starts, scenery.layouts.baked.vals, 3)


def _by_line(scenery, refusal, agents, agent_starts, texels, channels) -> JoinedRagged:
    """Returns texels by line. In ``agents``, those of environment e start at ``agent_starts[e]``;
    an object's are ``channels`` of its texel.

    A line is an agent's, an object's or a wall. Its piece of the other tensors is empty: tables end
    in an empty entry for this purpose.
    """
    walls, wall_texels = scenery.layouts.lines, scenery.layouts.textures
    layout, bounds = scenery.layout.long(), scenery.model_texels.long()
    n_agents_lines, n_walls = len(bounds) - 1, len(walls.vals)
    objects = scenery.objects
    n_moving = n_agents_lines + (len(objects.line_object) if objects else 0)
    n_lines = n_moving + walls.widths[layout]
    e = torch.repeat_interleave(torch.arange(scenery.n_envs, device=scenery.device), n_lines)
    line = torch.arange(len(e), device=scenery.device) - (n_lines.cumsum(0) - n_lines)[e]
    agent_line = line.clamp(max=n_agents_lines)
    wall = torch.where(line < n_moving, n_walls, walls.starts[layout[e]] + line - n_moving)
    parts = []
    if objects:
        of_object = (line >= n_agents_lines) & (line < n_moving)
        at = (line - n_agents_lines).clamp(0, len(objects.line_object) - 1)
        index = objects.line_object.long()[at]
        vals = objects.texels[..., channels].flatten(0, 1)
        parts = [(vals, e * objects.n_objects + index, of_object.long())]
    return JoinedRagged(
        refusal,
        (agents, agent_starts[e] + bounds[agent_line], _with_zero(bounds.diff())[agent_line]),
        *parts,
        (texels, _with_zero(wall_texels.starts)[wall], _with_zero(wall_texels.widths)[wall]),
    )


def _with_zero(table) -> torch.Tensor:
    """Returns a table with a zero appended."""
    return torch.cat([table, table.new_zeros(1)])
