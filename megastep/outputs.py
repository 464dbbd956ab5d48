"""What the engine's operations return.

N environments, A agents per environment, C cameras per agent (the axis is dropped if there is one),
R rays per camera, P pixels per camera, B lanes.
"""

from typing import NamedTuple

import torch

__all__ = ["Observation", "Physics", "Pong", "Render", "Shots", "Sought"]


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


class Pong(NamedTuple):
    """A step of a game of Pong, one value per lane."""

    reward: torch.Tensor  # (B,): 1 for a point won, -1 for one lost
    reset: torch.Tensor  # (B,) bool, as the next two
    terminal: torch.Tensor
    truncated: torch.Tensor
    points_won: torch.Tensor  # (B,): where a game ends, the share of its points; 0 elsewhere
    features: torch.Tensor | None  # (B, 1, 8) fp16; None where pixels were wanted


class Shots(NamedTuple):
    """A step of agents that hit whoever stands in the middle of their view, one value per lane."""

    reward: torch.Tensor  # (B,)
    reset: torch.Tensor  # (B,) bool, as the next two
    terminal: torch.Tensor
    truncated: torch.Tensor
    metrics: torch.Tensor  # (4, B): where an episode ends, kills, deaths, damage, accuracy; else 0
    vitals: torch.Tensor  # (B, 1, 3) fp16: health, whether it hit somebody, how many hit it
    told: torch.Tensor | None  # (B, 1, 1 + 5 (A - 1)): what a critic is told; None if not wanted


class Sought(NamedTuple):
    """A step of agents that seek a goal, one value per lane."""

    reward: torch.Tensor  # (B,)
    reset: torch.Tensor  # (B,) bool, as the next two
    terminal: torch.Tensor
    truncated: torch.Tensor
    metrics: torch.Tensor  # (4, B): where an episode ends, success, SPL, soft SPL, collisions
    bearing: torch.Tensor  # (B, 1, 3) fp16: metres / 10 straight, cosine and sine of the bearing
    told: torch.Tensor | None  # (B, 1, 4): what a critic is told; None if not wanted
