"""Robots: what a differential drive and its lidar can do. N environments, A agents, R rays."""

import math
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import torch
from pydantic import Field

from megastep import engine, plotting, spaces
from megastep.core import Core
from megastep.engine import MAX_RES, checks
from megastep.settings import frozen

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes

    from megastep.plotting import Area

Rate = Annotated[float, Field(gt=0, le=1000)]


@frozen
class Robot:
    """A round robot with two driven wheels. The defaults are those of a TurtleBot 4.

    Args:
        radius: of the disc around it, in metres.
        speed: highest speed forward and backward, m/s.
        turn_rate: highest rate of turning, rad/s.
        accel: highest change of the speed, m/s^2.
        turn_accel: highest change of the turning rate, rad/s^2.
        sensor: lidar, or rgb: cameras in its place.
        n_rays: rays of the lidar, evenly around it.
        range_min: metres below which the lidar measures nothing.
        range_max: metres beyond which the lidar measures nothing.
    """

    radius: Annotated[float, Field(gt=0, le=10)] = 0.17
    speed: Rate = 0.46
    turn_rate: Rate = 1.9
    accel: Rate = 0.9
    turn_accel: Rate = 7.7
    sensor: Literal["lidar", "rgb"] = "lidar"
    n_rays: Annotated[int, Field(ge=1, le=MAX_RES)] = 128
    range_min: Annotated[float, Field(ge=0, le=1000)] = 0.15
    range_max: Rate = 12.0


def headings(angles: torch.Tensor) -> torch.Tensor:
    """Returns the unit vectors (..., 2) along angles (...) in degrees, by the kernels' sine and
    cosine, which have the same bits on CPU and GPU.
    """
    quarters = (angles * (1 / 90)).round()
    x = (angles - quarters * 90) * (math.pi / 180)
    x2 = x * x
    sine = x + x * x2 * ((x2 * -1.9515295891e-4 + 8.3321608736e-3) * x2 - 1.6666654611e-1)
    rest = (x2 * 2.443315711809948e-5 - 1.388731625493765e-3) * x2 + 4.166664568298827e-2
    cosine = 1 - x2 * 0.5 + x2 * x2 * rest
    turns, odd = quarters.long() & 3, (quarters.long() & 1).bool()
    sine, cosine = torch.where(odd, cosine, sine), torch.where(odd, sine, cosine)
    sine = torch.where(turns >= 2, -sine, sine)
    cosine = torch.where((turns == 1) | (turns == 2), -cosine, cosine)
    return torch.stack([cosine, sine], -1)


class DifferentialMovement:
    """Actions set the speed ahead, in m/s, and the rate of turning to the left, in rad/s, which
    change by at most the robot's accelerations. A step is an arc, driven along its chord.

    A robot that hits something stops, and still turns. With ``slide`` it keeps its speed, and what
    the obstacle leaves of the step is made along x, then along y.

    Args:
        robot: its limits.
        slide: whether contacts deflect it.
    """

    def __init__(self, core: Core, robot: Robot | None = None, *, slide: bool = False):
        self.core, self.robot, self.slide = core, robot or Robot(), checks.flag("slide", slide)
        high = self.robot.speed, self.robot.turn_rate
        low = tuple(-value for value in high)
        self.space = spaces.MultiContinuous(core.n_agents, 2, low=low, high=high)
        self.low, self.high = self.space.tensors(core.device)
        accel = self.robot.accel, self.robot.turn_accel
        self.change = torch.tensor(accel, device=core.device) * (1 / core.fps)  # per step
        # one move, ahead, of which a control is a fraction
        self.moves = torch.tensor([[self.robot.speed, 0.0, 0.0]], device=core.device)
        self.last = torch.zeros((core.n_envs, core.n_agents), device=core.device)  # m/s ahead

    def twist(self) -> torch.Tensor:
        """Returns the speed ahead in m/s and the rate of turning in rad/s, (N, A, 2)."""
        agents = self.core.agents
        is_moving = (agents.velocity != 0).any(-1)  # not if it was stopped, or put elsewhere
        return torch.stack([self.last * is_moving, agents.angvelocity * (math.pi / 180)], -1)

    def __call__(self, decision: "Mapping") -> engine.Physics:
        """Moves the agents by ``decision["actions"]``, float32 (B, 1, 2), (N, A, 2) or (B, 2).
        Returns the :class:`~megastep.engine.Physics` of the step.
        """
        agents, shape = self.core.agents, (-1, *self.space.shape)
        n_lanes = self.core.n_envs * self.core.n_agents
        actions = checks.lanes("actions", decision["actions"], n_lanes, self.core.device, 2)
        actions = torch.minimum(torch.maximum(actions.reshape(shape), self.low), self.high)
        before = self.twist()
        change = torch.minimum(torch.maximum(actions - before, -self.change), self.change)
        speed, turn = (before + change).unbind(-1)
        half = turn * (0.5 / self.core.fps)  # radians, to the middle of the arc
        chord = speed * (1 - half * half * (1 / 6))
        degrees = half * (180 / math.pi)
        agents.angles.copy_(agents.angles + degrees)
        self.last.copy_(speed)
        move = self._sliding if self.slide else self._stopping
        physics = move(chord)
        angles = agents.angles + degrees
        agents.angles.copy_(angles - 360 * ((angles + 180) * (1 / 360)).floor())
        agents.angvelocity.copy_(turn * (180 / math.pi))
        return physics

    def _stopping(self, speed) -> engine.Physics:
        controls = (speed * (1 / self.robot.speed))[..., None]
        return engine.physics(self.core.scenery, self.core.agents, controls, self.moves)

    def _sliding(self, speed) -> engine.Physics:
        core, velocity = self.core, self.core.agents.velocity
        wanted = speed[..., None] * headings(core.agents.angles)
        velocity.copy_(wanted)
        physics = engine.physics(core.scenery, core.agents)
        rest = wanted * (1 - physics.progress)[..., None]
        for axis in (0, 1):
            velocity.zero_()
            velocity[..., axis].copy_(rest[..., axis])
            engine.physics(core.scenery, core.agents)
        velocity.copy_(wanted)
        return physics


class Lidar:
    """A range sensor of 360 degrees, with the meaning of ROS's LaserScan: see
    :func:`megastep.engine.scan`. Policies see float32 (N, A, 1, 1, R): 1 - range / ``range_max``,
    so 0 where nothing is within reach.

    Args:
        robot: has its rays and ranges.
    """

    def __init__(self, core: Core, robot: Robot | None = None):
        self.core, self.robot = core, robot or Robot()
        self.space = spaces.MultiImage(1, 1, 1, self.robot.n_rays, low=0, high=1)

    def ranges(self, core: Core | None = None) -> torch.Tensor:
        """Returns metres, (N, A, R); inf beyond ``range_max``, -inf below ``range_min``."""
        core, robot = core or self.core, self.robot
        limits = robot.range_min, robot.range_max
        return engine.scan(core.scenery, core.agents, robot.n_rays, *limits)

    def __call__(self) -> torch.Tensor:
        """Returns the observation, (N, A, 1, 1, R)."""
        near = 1 - (self.ranges() * (1 / self.robot.range_max)).clamp(0, 1)
        return near[:, :, None, None]

    def state(self, e: int = 0) -> torch.Tensor:
        """Returns the metres of environment ``e``: (A, R)."""
        return self.ranges(self.core.alone(e))[0]

    @staticmethod
    def plot_state(
        state: np.ndarray,
        axes: "Sequence[Area | Axes] | None" = None,
        range_max: float | None = None,
    ) -> np.ndarray:
        """Draws a numpyified :meth:`state` as one strip per agent, bright where near, from what is
        ahead over the left to the right. Returns the axes.
        """
        far = range_max or max(state[np.isfinite(state)].max(initial=1.0), 1.0)
        near = 1 - np.clip(state / far, 0, 1)
        return plotting.plot_images(
            dict(scan=near[:, None, None]), aspect=plotting.STRIP, axes=axes
        )
