"""Keys: the environment, its step as one operation (with its kernel), and its episodes."""

from megastep.envs.keys.env import Keys

__all__ = ["Keys"]
