"""Memory: the environment, its step as one operation (with its kernel), and where objects lie."""

from megastep.envs.memory.env import Memory

__all__ = ["Memory"]
