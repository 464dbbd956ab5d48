"""What drives beside the policy: random actions, a reactive controller, and one that follows a
path. Each has `begin(episode)` and `act(ranges, twist, pose, goal)`, which returns (m/s, rad/s);
goals are in metres ahead and to the left.
"""

import math

import numpy as np
from episodes import to_robot


class Trained:
    """The exported policy, which draws actions, or takes their means."""

    def __init__(self, policy, draws=True):
        self.policy, self.draws = policy, draws

    def begin(self, episode):
        self.policy.begin(episode.number if self.draws else None)

    def act(self, ranges, twist, pose, goal):
        return self.policy.act(ranges, twist, goal)


class Random:
    """Actions as an untrained policy takes: uniform, each for half a second."""

    def __init__(self, robot):
        self.limits = np.array([robot["speed"], robot["turn_rate"]])

    def begin(self, episode):
        self.random, self.left = np.random.default_rng(episode.number), 0

    def act(self, ranges, twist, pose, goal):
        if self.left == 0:
            self.action, self.left = self.limits * self.random.uniform(-1, 1, 2), 5
        self.left -= 1
        return self.action


class Scripted:
    """Turns to the free direction nearest to the goal's, and drives: a vector field histogram
    (Borenstein and Koren 1991) without a map, so it has no way out of dead ends.
    """

    MARGIN = 0.06  # metres beside the robot
    AHEAD = 0.8  # metres that must be free

    def __init__(self, robot):
        self.robot = robot

    def begin(self, episode):
        self.last = 0.0

    def act(self, ranges, twist, pose, goal):
        n, robot = len(ranges), self.robot
        angles = (2 * np.pi * np.arange(n) / n + np.pi) % (2 * np.pi) - np.pi
        far = np.where(np.isfinite(ranges), ranges, robot["range_max"])
        bearing, distance = math.atan2(goal[1], goal[0]), math.hypot(*goal)
        candidates = np.append(angles, bearing)
        offsets = angles[None] - candidates[:, None]  # (candidates, rays)
        ahead, aside = far * np.cos(offsets), np.abs(far * np.sin(offsets))
        blocks = (ahead > 0) & (aside < robot["radius"] + self.MARGIN)
        free = np.where(blocks, ahead, np.inf).min(1) - robot["radius"]
        is_open = free > min(self.AHEAD, distance)
        turn = np.abs((candidates - bearing + np.pi) % (2 * np.pi) - np.pi)
        change = np.abs((candidates - self.last + np.pi) % (2 * np.pi) - np.pi)
        best = int(np.argmin(np.where(is_open, turn + 0.3 * change, 10 - free)))
        self.last, heading = candidates[best], candidates[best]
        return pursue(robot, heading, min(distance, max(free[best], 0.1)))


class FollowPath:
    """Follows a path of points 0.4 m ahead (pure pursuit). `plan(episode)` returns (P, 2) metres,
    or None.
    """

    LOOK = 0.4  # metres

    def __init__(self, robot, plan):
        self.robot, self.plan = robot, plan

    def begin(self, episode):
        path = self.plan(episode)
        self.path = episode.goal[None] if path is None else dense(path)
        self.at = 0

    def act(self, ranges, twist, pose, goal):
        distances = np.hypot(*(self.path - pose[:2]).T)
        self.at = max(self.at, int(distances.argmin()))
        beyond = np.flatnonzero(distances[self.at :] > self.LOOK)
        target = self.path[self.at + beyond[0]] if len(beyond) else self.path[-1]
        ahead, left = to_robot(pose, target)
        return pursue(self.robot, math.atan2(left, ahead), math.hypot(ahead, left))


def pursue(robot, heading, distance):
    """Returns (m/s, rad/s) towards a heading: turns on the spot if it is far aside."""
    turn = np.clip(2.5 * heading, -robot["turn_rate"], robot["turn_rate"])
    speed = robot["speed"] * max(0.0, math.cos(heading)) ** 3
    return np.array([min(speed, 1.5 * distance), turn])


def dense(path, gap=0.05):
    """Returns a path with a point every few centimetres."""
    counts = [max(int(np.hypot(*(b - a)) / gap), 1) for a, b in zip(path, path[1:])]
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(path, path[1:], counts)]
    return np.concatenate([*pieces, path[-1:]])
