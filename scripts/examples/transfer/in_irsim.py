"""IR-SIM 2.12 as one of the simulators: `pip install ir-sim`. 2D, with contacts of rigid bodies."""

import contextlib
import io
import os
import tempfile

import numpy as np
import yaml

with contextlib.redirect_stdout(io.StringIO()):  # it says which windows it cannot open
    import irsim
from irsim.lib.path_planners.jps import JPSPlanner
from irsim.world.map import Map


class InIrsim:
    """Args: robot: the description's. steps_per_second: of the policy."""

    name = "irsim"

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
        walls = [
            dict(shape={"name": "linestring", "vertices": line}, state=[0, 0, 0])
            for line in polylines(episode.walls)
        ]
        width, height = (high - low + 2).tolist()
        world = dict(
            width=width,
            height=height,
            offset=(low - 1).tolist(),
            step_time=self.step_time,
            collision_mode="contact",
        )
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "world.yaml")
            with open(path, "w") as file:
                yaml.safe_dump(_plain(dict(world=world, robot=[body], obstacle=walls)), file)
            self.env = irsim.make(path, headless=True, log_level="ERROR")
        self.body = self.env.robot

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


def polylines(walls, most=9):
    """Returns walls (W, 2, 2) as lines through a few points each, [[x, y], ...], which it handles
    faster.
    """
    left = {k: wall.tolist() for k, wall in enumerate(walls)}
    ends = {}
    for k, (a, b) in left.items():
        ends.setdefault(tuple(a), []).append(k)
        ends.setdefault(tuple(b), []).append(k)
    lines = []
    while left:
        line = left.pop(next(iter(left)))
        while len(line) < most and (more := [k for k in ends[tuple(line[-1])] if k in left]):
            a, b = left.pop(more[0])
            line.append(b if a == line[-1] else a)
        lines.append(line)
    return lines


def plan(episode, radius, cell=0.1):
    """Returns the path (P, 2) of IR-SIM's own planner, jump point search (Harabor and Grastien
    2011), on a grid of the walls widened by a radius; None if it finds none.
    """
    low = episode.walls.reshape(-1, 2).min(0) - 0.5
    size = episode.walls.reshape(-1, 2).max(0) + 0.5 - low
    shape = np.ceil(size / cell).astype(int)
    centres = low + cell * (np.stack(np.indices(shape), -1) + 0.5)
    near = np.full(shape, np.inf)
    for a, b in episode.walls.astype(float):
        along = b - a
        t = np.clip(((centres - a) @ along) / max(along @ along, 1e-12), 0, 1)
        near = np.minimum(near, np.hypot(*np.moveaxis(centres - a - t[..., None] * along, -1, 0)))
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


def _plain(tree):
    """Returns nested dicts and lists of Python's own numbers, as YAML has them."""
    if isinstance(tree, dict):
        return {key: _plain(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_plain(value) for value in tree]
    return tree.item() if isinstance(tree, np.generic) else tree
