"""The outputs of the engine's operations.

N environments, A agents per environment, C cameras per agent (the axis is dropped if there is one),
R rays per camera, P pixels per camera.
"""

from typing import NamedTuple

import torch

__all__ = ["Observation", "Physics", "Render"]


class Render(NamedTuple):
    """The cameras' views, ray by ray. A ray that hits nothing has -1, NaN, NaN, inf, black."""

    indices: torch.Tensor  # (N, A, C, R) int32: the line hit, an index into its environment
    locations: torch.Tensor  # (N, A, C, R): position along the line, 0 to 1
    dots: torch.Tensor  # (N, A, C, R): cosine between ray and line
    distances: torch.Tensor  # (N, A, C, R): metres
    screen: torch.Tensor  # (N, A, C, R, 3): linear light; call gamma_encode to display it


class Physics(NamedTuple):
    """The outcome of a step of physics."""

    # (N, A): free fraction of the step; below 1, the agent hit something and its velocities are now
    # 0
    progress: torch.Tensor


class Observation(NamedTuple):
    """Observations for a policy; None where not requested."""

    rgb: torch.Tensor | None  # (N, A, C, 3, P) fp16, linear light
    depth: torch.Tensor | None  # (N, A, C, P) fp16: 1 at the agent's radius, 0 at max_depth beyond
    centre_line: torch.Tensor | None  # (N, A, C) int32: the line at the centre, as Render.indices
    agent_ray: torch.Tensor | None  # (N, A, C) int32: ray closest to the centre that hits an agent
    imu: torch.Tensor | None  # (N, A, 3) fp16: angvelocity / 360, own velocity ahead and left / 10
    newly_seen: torch.Tensor | None  # (N, A) int32: texels newly marked in `seen`
