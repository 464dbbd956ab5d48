"""Baked light."""

import torch

from megastep.engine import checks
from megastep.engine.launch_params import scenery_params
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import ENGINE, launch

__all__ = ["bake"]


def bake(scenery: Scenery) -> None:
    """Computes the light on every wall texel, in place. Call it after moving walls or lights.

    Writes ``scenery.layouts.baked``: min(1, 0.1 + sum of 2 I / max(d^2, 1)) over the lights of the
    layout that no wall occludes, with intensity I and distance d. Also refits the walls' bounding
    boxes.
    """
    layouts = checks.instance("scenery", scenery, Scenery).layouts
    packed_scenery = scenery_params(scenery, 0.0)
    layouts.update_bounding_boxes()
    texel_wall = _owners(layouts.textures.widths, layouts.n_texels)
    wall_layout = _owners(layouts.lines.widths, layouts.n_walls)
    launch(
        *(ENGINE, "bake", scenery.device, layouts.n_texels),
        scenery=packed_scenery,
        texel_wall=texel_wall,
        wall_layout=wall_layout,
        n_texels=layouts.n_texels,
    )


def _owners(widths, total) -> torch.Tensor:
    """Returns (total,) int32, the subarray that each element belongs to."""
    subarrays = torch.arange(len(widths), dtype=torch.int32, device=widths.device)
    return torch.repeat_interleave(subarrays, widths, output_size=total)
