"""PointGoal: the environment, and its step as one operation with its kernel."""

from megastep.envs.pointgoal.pointgoal import PointGoal, PointGoalStep, pointgoal_step

__all__ = ["PointGoal", "PointGoalStep", "pointgoal_step"]
