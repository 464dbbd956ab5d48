"""Movement: actions to velocities to places, and vectors between the two frames.

N environments, A agents, B = N A lanes.
"""

from collections.abc import Mapping
from typing import Any

import torch

from megastep import engine, spaces
from megastep.modules.lanes import to_agents

# What each action adds to the velocity in the agent's frame, ahead and left, and to its turn:
# 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right.
MOVES = [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0), (0, 0), (0, 0)]
TURNS = [0, 0, 0, 0, 0, 1, -1]


def to_global(angles: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Vectors (..., 2) of agents' frames, turned by ``angles`` (...) degrees into the global
    frame.
    """
    radians = torch.deg2rad(angles)
    s, c = radians.sin(), radians.cos()
    x, y = vectors[..., 0], vectors[..., 1]
    return torch.stack([c * x - s * y, s * x + c * y], -1)


def to_local(angles: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Vectors (..., 2) of the global frame, turned into agents' frames at ``angles`` (...)
    degrees.
    """
    return to_global(-angles, vectors)


class _Movement:
    """Seven actions: each adds a velocity once the fraction ``damping`` of the old one is lost."""

    def __init__(self, core: Any, speed: float, ang_speed: float, damping: float):
        self.core, self.damping = core, damping
        self.moves = torch.tensor(
            [(speed * x, speed * y, ang_speed * turn) for (x, y), turn in zip(MOVES, TURNS)],
            dtype=torch.float32,
            device=core.device,
        )
        self.space = spaces.MultiDiscrete(core.n_agents, len(MOVES))

    def __call__(self, decision: Mapping) -> engine.Physics:
        """Takes ``decision.actions``, integers (B, 1), (N, A) or (B,), and moves the agents."""
        actions = to_agents(decision["actions"], self.core.n_agents).long().contiguous()
        return engine.physics(
            self.core.scenery, self.core.agents, actions, self.moves, self.damping
        )


class SimpleMovement(_Movement):
    """Velocity is what the action says: ``speed`` m/s along an axis of the agent, ``ang_speed``
    deg/s about it, for one step.
    """

    def __init__(self, core: Any, speed: float = 10.0, ang_speed: float = 180.0):
        super().__init__(core, speed, ang_speed, damping=1.0)


class MomentumMovement(_Movement):
    """Actions accelerate: ``accel`` m/s^2 and ``ang_accel`` deg/s^2, against a ``decay`` of both
    velocities by that fraction per step.
    """

    def __init__(
        self, core: Any, accel: float = 5.0, ang_accel: float = 180.0, decay: float = 0.125
    ):
        super().__init__(core, accel / core.fps, ang_accel / core.fps, damping=decay)
