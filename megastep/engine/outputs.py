"""What the engine's operations return.

N environments, A agents per environment, C cameras per agent (the axis is dropped if there is one),
R rays per camera, P pixels per camera, B lanes.
"""

from typing import NamedTuple

import torch

__all__ = ["Observation", "Physics", "Render"]


class Render(NamedTuple):
    """What the cameras see, ray by ray. A miss is -1, NaN, NaN, inf, black."""

    indices: torch.Tensor  # (N, A, C, R) int32: the line hit, of its environment's lines
    locations: torch.Tensor  # (N, A, C, R): where along the line, 0 to 1
    dots: torch.Tensor  # (N, A, C, R): cosine between ray and line
    distances: torch.Tensor  # (N, A, C, R): metres
    screen: torch.Tensor  # (N, A, C, R, 3): linear light; gamma_encode it before showing it


class Physics(NamedTuple):
    """``progress`` (N, A): the fraction of the step that was free; below 1 the agent met something
    and its velocities are now 0.
    """

    progress: torch.Tensor


class Observation(NamedTuple):
    """What a policy needs of a view; None where it was not wanted."""

    rgb: torch.Tensor | None  # (N, A, C, 3, P) fp16, linear light
    depth: torch.Tensor | None  # (N, A, C, P) fp16: 1 at the agent's radius, 0 at max_depth beyond
    centre_line: torch.Tensor | None  # (N, A, C) int32: the line at the centre, as Render.indices
    agent_ray: (
        torch.Tensor | None
    )  # (N, A, C) int32: nearest to the centre that shows another agent
    imu: torch.Tensor | None  # (N, A, 3) fp16: angvelocity / 360, own velocity ahead and left / 10
    newly_seen: torch.Tensor | None  # (N, A) int32: texels now marked in `seen`, not before
