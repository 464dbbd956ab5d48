"""Environments of Gymnasium and of the packages that register theirs with it."""

from megastep.envs.gymnasium.env import Gymnasium

__all__ = ["Gymnasium"]
