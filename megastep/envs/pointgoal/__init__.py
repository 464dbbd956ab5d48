"""PointGoal: the environment, with the kernel of its step."""

from megastep.envs.pointgoal.pointgoal import PointGoal

__all__ = ["PointGoal"]
