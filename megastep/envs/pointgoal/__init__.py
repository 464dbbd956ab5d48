"""PointGoal: the environment, its step as one operation (with its kernel), and shortest paths."""

from megastep.envs.pointgoal.env import PointGoal

__all__ = ["PointGoal"]
