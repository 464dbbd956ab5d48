"""Scenery by environment: read-only copies that join its agents, its objects and its layout.

N environments, A agents per environment, M lines of the agent model, K texels of one environment's
agents, L lines of all environments.
"""

import torch

from megastep.ragged import RaggedTorch
from megastep.read_only import ReadOnlyTensor

__all__ = ["baked", "lights", "lines", "textures"]


def _joined(
    name: str, *parts: tuple[torch.Tensor, torch.Tensor, torch.Tensor], cure: str = ""
) -> RaggedTorch:
    """Returns a Ragged whose subarrays each join pieces [start, start + width) of some tensors.

    Args:
        name: of the attribute, for errors.
        parts: (vals (V, ...), starts (D,), widths (D,)) of each tensor.
        cure: more words for errors.
    """
    refusal = (
        f"scenery.{name} is a read-only copy: write into scenery.layouts.{name}, which reaches "
        f"every environment that shows the layout{cure}"
    )
    vals, starts, widths = zip(*parts)
    before = torch.tensor([0, *map(len, vals)]).cumsum(0).tolist()
    starts = torch.stack([start + n for start, n in zip(starts, before)], 1).flatten()
    of_pieces = torch.stack(widths, 1).flatten()
    first = torch.repeat_interleave(starts - (of_pieces.cumsum(0) - of_pieces), of_pieces)
    index = torch.arange(len(first), device=first.device) + first
    total = torch.stack(widths).sum(0)
    return RaggedTorch(
        ReadOnlyTensor(torch.cat(vals)[index], refusal), ReadOnlyTensor(total, refusal)
    )


def lines(scenery) -> RaggedTorch:
    """Returns the lines (l, 2, 2) of each environment as last rendered: its agents', then its
    objects', then walls.
    """
    layout, walls = scenery.layout.long(), scenery.layouts.lines
    moving = [scenery.agent_lines, *([scenery.objects.lines] if scenery.objects else [])]
    e = torch.arange(scenery.n_envs, device=scenery.device)
    return _joined(
        "lines",
        *((x.flatten(0, 1), e * x.shape[1], torch.full_like(e, x.shape[1])) for x in moving),
        (walls.vals, walls.starts[layout], walls.widths[layout]),
        cure=", and call bake; agents' lines follow agents.positions at each render",
    )


def lights(scenery) -> RaggedTorch:
    """Returns the lights (l, 3) of each environment."""
    layout, lights = scenery.layout.long(), scenery.layouts.lights
    part = lights.vals, lights.starts[layout], lights.widths[layout]
    return _joined("lights", part, cure=", and call bake")


def textures(scenery) -> RaggedTorch:
    """Returns the texels (w, 3) of each line of all environments."""
    agents, texels = scenery.layouts.agent_textures, scenery.layouts.textures.vals
    starts = scenery.layout.long() * agents.shape[1]
    cure = "; agents' are in scenery.layouts.agent_textures"
    return _by_line(scenery, "textures", agents.flatten(0, 1), starts, texels, slice(3), cure)


def baked(scenery) -> RaggedTorch:
    """Returns the light (w,) on each line of all environments."""
    agents, light = scenery.agent_light, scenery.layouts.baked.vals
    starts = torch.arange(scenery.n_envs, device=scenery.device) * agents.shape[1]
    cure = "; agents' light is computed at each render"
    return _by_line(scenery, "baked", agents.flatten(), starts, light, 3, cure)


def _by_line(scenery, name, agents, agent_starts, texels, channels, cure) -> RaggedTorch:
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
    parts = [(agents, agent_starts[e] + bounds[agent_line], _with_zero(bounds.diff())[agent_line])]
    if objects:
        of_object = (line >= n_agents_lines) & (line < n_moving)
        at = (line - n_agents_lines).clamp(0, len(objects.line_object) - 1)
        index = objects.line_object.long()[at]
        vals = objects.texels[..., channels].flatten(0, 1)
        parts.append((vals, e * objects.n_objects + index, of_object.long()))
    of_wall = _with_zero(wall_texels.starts)[wall], _with_zero(wall_texels.widths)[wall]
    return _joined(name, *parts, (texels, *of_wall), cure=cure)


def _with_zero(table) -> torch.Tensor:
    return torch.cat([table, table.new_zeros(1)])
