"""PointGoal: the environment, its step as one operation, and shortest paths to goals."""

from megastep.envs.pointgoal.env import PointGoal

__all__ = ["PointGoal"]
