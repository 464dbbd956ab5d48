"""megastep as one of the simulators: a robot in one home, driven from outside."""

import math

import numpy as np
import torch

from megastep import modules, scene
from megastep.core import Core
from megastep.dotdict import dotdict


class InMegastep:
    """Args: robot: the description's. steps_per_second: of the policy."""

    def __init__(self, robot, steps_per_second):
        self.robot, self.fps = modules.Robot(**robot), steps_per_second

    def begin(self, episode):
        """Puts the robot at the start of an episode, at rest."""
        geometry = dotdict(
            id=str(episode.home),
            walls=episode.walls,
            lights=episode.walls.mean((0, 1))[None],
            masks=np.ones((1, 1), np.int16),
            res=0.2,
        )
        scenery = scene.scenery([geometry], n_agents=1, n_envs=1, device="cpu")
        sees = self.robot.sensor == "rgb"
        self.core = Core(scenery, res=256 if sees else 1, fps=self.fps, radius=self.robot.radius)
        self.core.agents.positions[0, 0] = torch.from_numpy(episode.start[:2])
        self.core.agents.angles[0, 0] = math.degrees(episode.start[2])
        self.movement = modules.DifferentialMovement(self.core, self.robot)
        self.lidar, self.rgb = modules.Lidar(self.core, self.robot), modules.RGB
        self.sense = self._rgb if sees else self._ranges

    def _ranges(self):
        return self.lidar.ranges()[0, 0].numpy()

    def _rgb(self):
        return self.rgb(self.core, 4)()[0, 0, :, 0].numpy()

    def pose(self):
        """Returns (x, y, radians)."""
        agents = self.core.agents
        return np.array([*agents.positions[0, 0].tolist(), math.radians(agents.angles.item())])

    def twist(self):
        """Returns (m/s ahead, rad/s)."""
        return self.movement.twist()[0, 0].numpy()

    def drive(self, command):
        """Drives for one step of the policy. Returns whether the robot touched a wall."""
        actions = torch.tensor(np.asarray(command), dtype=torch.float32).view(1, 1, 2)
        return self.movement(dict(actions=actions)).progress.item() < 1
