"""IR-SIM 2.12 as one of the simulators: `pip install ir-sim`. 2D, with contacts of rigid bodies."""

import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np
import shapely

with contextlib.redirect_stdout(io.StringIO()):  # it says which windows it cannot open
    import irsim
from irsim.lib.path_planners.jps import JPSPlanner
from irsim.world.map import Map
from irsim.world.map.obstacle_map import ObstacleMap


class Walls(ObstacleMap):
    """IR-SIM's floor plan, of lines in place of the edges of a grid's cells. It finds those near a
    robot by a tree, and so is faster than an obstacle for each wall; ranges and contacts are equal.
    """

    def __init__(self, walls):
        super().__init__(shape=dict(name="map", points=np.zeros((2, 1)), reso=1.0))
        self._geometry = self.gf.geometry = shapely.multilinestrings(walls.astype(float))
        self.linestrings = [*self._geometry.geoms]
        self.geometry_tree = shapely.STRtree(self.linestrings)


class InIrsim:
    """Args: robot: the description's. steps_per_second: of the policy."""

    def __init__(self, robot, steps_per_second):
        self.robot, self.step_time = robot, 1 / steps_per_second

    def begin(self, episode):
        """Makes a world with the walls and the robot at the start of an episode."""
        robot, n = self.robot, self.robot["n_rays"]
        low, high = episode.walls.reshape(-1, 2).min(0), episode.walls.reshape(-1, 2).max(0)
        limits = [robot["speed"], robot["turn_rate"]]
        # its beams are angle_range / (n - 1) apart, from -angle_range / 2 on; so they are the
        # policy's, which end with the one to the rear
        lidar = dict(
            type="lidar2d",
            number=n,
            angle_range=2 * np.pi * (n - 1) / n,
            range_min=robot["range_min"],
            range_max=robot["range_max"],
            offset=[0.0, 0.0, 0.0 if n % 2 else np.pi / n],
        )
        body = dict(
            kinematics={"name": "diff"},
            shape={"name": "circle", "radius": robot["radius"]},
            state=episode.start.tolist(),
            vel_min=[-value for value in limits],
            vel_max=limits,
            acce=[robot["accel"], robot["turn_accel"]],
            sensors=[lidar],
            mass=3.3,
        )
        world = dict(
            **dict(zip(("width", "height"), (high - low + 2).tolist())),
            offset=(low - 1).tolist(),
            step_time=self.step_time,
            collision_mode="contact",
        )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "world.yaml"  # JSON is YAML
            path.write_text(json.dumps(dict(world=world, robot=[body])))
            self.env = irsim.make(str(path), headless=True, log_level="ERROR")
        self.env.add_object(Walls(episode.walls))
        self.body = self.env.robot
        self.body.sensor_step()  # which sees the walls now

    def sense(self):
        """Returns the ranges of the policy's rays in metres, inf without a return."""
        sensor, n = self.body.sensors[0], self.robot["n_rays"]
        ranges = np.where(sensor.range_data < sensor.range_max, sensor.range_data, np.inf)
        return np.roll(ranges, -((n - 1) // 2))  # to begin with the beam that looks ahead

    def pose(self):
        """Returns (x, y, radians)."""
        return self.body.state[:3, 0].astype(float)

    def twist(self):
        """Returns (m/s ahead, rad/s)."""
        return self.body.velocity[:2, 0].astype(float)

    def drive(self, command):
        """Drives for one step of the policy. Returns whether the robot touched a wall."""
        self.env.step(np.asarray(command, float).reshape(2, 1))
        return bool(self.body.contact.reports)

    def messages(self):
        """Returns its LaserScan and Odometry, as dicts in the form of ROS."""
        message = self.env.get_msg(use_inf=True).robots[0]
        return message.scan.to_dict(), message.odom.to_dict()


def plan(episode, radius, cell=0.1):
    """Returns the path (P, 2) of IR-SIM's own planner, jump point search (Harabor and Grastien
    2011), on a grid of the walls widened by a radius; None if it finds none.
    """
    low = episode.walls.reshape(-1, 2).min(0) - 0.5
    size = episode.walls.reshape(-1, 2).max(0) + 0.5 - low
    shape = np.ceil(size / cell).astype(int)
    centres = low + cell * (np.stack(np.indices(shape), -1) + 0.5)
    near = shapely.distance(shapely.points(centres), shapely.multilinestrings(episode.walls))
    for gap in (0.06, 0.03, 0.0):
        grid = np.where(near < radius + gap, 100.0, 0.0)
        world = Map(*(cell * shape).tolist(), cell, grid=grid, world_offset=low.tolist())
        with contextlib.redirect_stdout(io.StringIO()):
            path = JPSPlanner(world).planning(
                episode.start[:2, None], episode.goal[:, None], show_animation=False
            )
        if path is not None and np.size(path):
            return np.append(np.asarray(path, float).T[::-1][:-1], episode.goal[None], 0)
    return None
