"""A bot that plays Deathmatch. n lanes, A agents per environment, L landmarks per plan."""

import math
from typing import Any

import torch

from megastep.agents.selfplay.bots.steering import HORIZON, SIGHT, SLACK, Pose
from megastep.agents.selfplay.bots.walker import Explorer
from megastep.arrdict import arrdict

BEHIND = 0.3  # metres by which the wall that a pixel shows may be nearer than the agent there
LEAD = 0.1  # seconds by which it aims ahead of where an agent is
APART = 1.0  # metres to which it approaches an agent
HALF_WIDTH = 0.06  # metres beside the middle of an agent that it aims at
AIMING = 4.0  # how much aiming counts beside walking
FINE, STEP = 3.0, 0.1  # degrees off within which it turns for the next step, in seconds
SEARCHED = 3.0  # metres of floor around an agent lost from sight that it searches again
CHASE = 60  # steps that it goes after an agent lost from sight


class Hunter(Explorer):
    """Explores until it sees another agent of a Deathmatch, then aims at it and approaches. It
    searches around where it lost one from sight, and turns to the nearest when it is hit.

    It knows what an `Explorer` knows, and the pose and velocity of the agents that it sees.
    """

    def __init__(self, env: Any):
        super().__init__(env)
        if not {"d", "health"} <= {*env.obs_space} or env.n_agents < 2:
            raise ValueError("it hunts by the observations d and health, as Deathmatch has them")

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        steering, obs = self.steering, world["obs"]
        state = self._explore(world["reset"], state, pose, near)
        other, sees = self._nearest(pose, obs["d"])
        # where to search for the other once it is lost from sight
        lengths = steering.lengths(steering.near(other))
        around = (lengths < SEARCHED) & sees[:, None]
        state = arrdict(
            seen=state["seen"] & ~around,
            target=torch.where(sees, lengths.argmin(1), state["target"]),
            patience=torch.where(sees, CHASE, state["patience"]),
        )
        fights = (sees | (obs["health"][:, 0, 2] > 0))[:, None]
        away = (other.position - pose.position).norm(dim=-1, keepdim=True)
        aim = steering.aim(pose, near, state["target"])
        aim = torch.where(fights & (away < APART), pose.position, aim)
        gaze = other.position + LEAD * (other.velocity - pose.velocity)
        off = steering.bearings(pose, (gaze - pose.position)[:, None]).abs()
        slack = torch.rad2deg(torch.atan(HALF_WIDTH / away.clamp(min=0.1)))
        decision = steering.decide(
            pose,
            aim,
            torch.where(fights, gaze, aim),
            turning=torch.where(fights, AIMING, 1.0),
            slack=torch.where(fights, slack, SLACK),
            horizon=torch.where(fights & (off < FINE), STEP, HORIZON),
        )
        return decision, state

    def _nearest(self, pose: Pose, depth: torch.Tensor) -> tuple[Pose, torch.Tensor]:
        """Of those in view first; and whether it is in view (n,)."""
        steering = self.steering
        core, lanes, n_pixels = steering.core, steering.lanes[:, None], depth.shape[-1]
        slots = lanes + torch.arange(1, core.n_agents, device=lanes.device)
        others = lanes - lanes % core.n_agents + slots % core.n_agents  # (n, A - 1)
        offsets = core.agents.positions.view(-1, 2)[others] - pose.position[:, None]
        away, bearing = offsets.norm(dim=-1), steering.bearings(pose, offsets)
        sideways = torch.tan(torch.deg2rad(bearing)) / math.tan(math.radians(core.fov / 2))
        pixel = (0.5 * n_pixels * (1 - sideways)).clamp(0, n_pixels - 1).long()
        wall = core.agents.radius + SIGHT * (1 - depth.reshape(len(depth), -1).gather(1, pixel))
        sees = (bearing.abs() < core.fov / 2) & (away < SIGHT) & (wall > away - BEHIND)
        nearest = torch.where(sees, away, away + 1e3).argmin(1, True)
        return steering.pose(others.gather(1, nearest)[:, 0]), sees.any(1)
