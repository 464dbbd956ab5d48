"""Keys: the environment, with the kernel of its step."""

from megastep.envs.keys.keys import Keys

__all__ = ["Keys"]
