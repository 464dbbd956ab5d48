"""Explorer: the environment, and its step as one operation with its kernel."""

from megastep.envs.explorer.env import Explorer

__all__ = ["Explorer"]
