"""Movement by actions, and vectors between the global frame and agents' frames. N environments of
A agents, B = N A lanes.
"""

import math
from collections.abc import Mapping

import torch

from megastep import engine, spaces
from megastep.core import Core
from megastep.engine import checks

# The direction in the agent's frame (forward, left) and the turn of each action:
# 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right.
MOVES = [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0), (0, 0), (0, 0)]
TURNS = [0, 0, 0, 0, 0, 1, -1]  # turn of each action: 1 left, -1 right
CONTROLS = [3, 1, 5]  # the actions that a continuous action weights: forward, left, turn left


def to_lanes(values: torch.Tensor) -> torch.Tensor:
    """Returns (N, A, ...) as lanes (B, ...): lane e A + a is agent a of environment e."""
    return values.flatten(0, 1)


def to_agents(values: torch.Tensor, n_agents: int) -> torch.Tensor:
    """Returns lanes (B,) or (B, 1), or (N, A), as (N, A), a view if possible."""
    return values.reshape(-1, n_agents)


def to_global(angles: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Rotates vectors (..., 2) from frames of headings ``angles`` (...), degrees, to the global."""
    radians = torch.deg2rad(angles)
    s, c = radians.sin(), radians.cos()
    x, y = vectors[..., 0], vectors[..., 1]
    return torch.stack([c * x - s * y, s * x + c * y], -1)


def to_local(angles: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Rotates vectors (..., 2) from the global frame into agents' frames."""
    return to_global(-angles, vectors)


class _Movement:
    """A step first removes the fraction ``damping`` of the velocity, then adds the action's."""

    def __init__(self, core: Core, numbers: dict, damping: float, control: str, scale: float = 1.0):
        values = (
            checks.number(name, value, -math.inf, math.inf) for name, value in numbers.items()
        )
        speed, ang_speed = (value / scale for value in values)
        self.core, self.damping = core, damping
        self.control = checks.word("control", control, ("discrete", "continuous"))
        self.moves = torch.tensor(
            [(speed * x, speed * y, ang_speed * turn) for (x, y), turn in zip(MOVES, TURNS)],
            dtype=torch.float32,
            device=core.device,
        )
        self.space = spaces.MultiDiscrete(core.n_agents, len(MOVES))
        if control == "continuous":
            self.moves = self.moves[CONTROLS]
            self.space = spaces.MultiContinuous(core.n_agents, len(CONTROLS))

    def __call__(self, decision: Mapping) -> engine.Physics:
        """Moves the agents by ``decision["actions"]``: integers (B, 1), (N, A) or (B,), or float32
        (B, 1, 3), (N, A, 3) or (B, 3). Returns the :class:`~megastep.engine.Physics` of the step.
        """
        n_agents, device = self.core.n_agents, self.core.device
        n_lanes, actions = self.core.n_envs * n_agents, decision["actions"]
        if self.control == "continuous":
            actions = checks.lanes("actions", actions, n_lanes, device, len(CONTROLS))
            actions = actions.reshape(-1, *self.space.shape).contiguous()
        else:
            actions = checks.lanes("actions", actions, n_lanes, device)
            actions = to_agents(actions, n_agents).long().contiguous()
        return engine.physics(
            self.core.scenery, self.core.agents, actions, self.moves, self.damping
        )


class SimpleMovement(_Movement):
    """Actions set the velocity for one step.

    Args:
        speed: m/s, along an axis of the agent.
        ang_speed: deg/s.
        control: discrete for seven actions (MultiDiscrete), or continuous for three numbers from
            -1 to 1 (MultiContinuous): fractions of the speed ahead, the speed to the left and the
            turning rate to the left. Numbers beyond are clipped.
    """

    def __init__(
        self, core: Core, speed: float = 10.0, ang_speed: float = 180.0, *, control="discrete"
    ):
        super().__init__(core, dict(speed=speed, ang_speed=ang_speed), 1.0, control)


class MomentumMovement(_Movement):
    """Actions accelerate the agent.

    Args:
        accel: m/s^2, along an axis of the agent.
        ang_accel: deg/s^2.
        decay: fraction of both velocities that is lost per step.
        control: as of :class:`SimpleMovement`, but of accelerations.
    """

    def __init__(
        self,
        core: Core,
        accel: float = 5.0,
        ang_accel: float = 180.0,
        decay: float = 0.125,
        *,
        control: str = "discrete",
    ):
        decay = checks.number("decay", decay, -math.inf, math.inf)
        rates = dict(accel=accel, ang_accel=ang_accel)
        super().__init__(core, rates, decay, control, core.fps)
