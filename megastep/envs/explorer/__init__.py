"""Explorer: the environment, with the kernel of its step."""

from megastep.envs.explorer.explorer import Explorer

__all__ = ["Explorer"]
