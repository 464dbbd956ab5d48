"""Memory: the environment, with the kernel of its step."""

from megastep.envs.memory.memory import Memory

__all__ = ["Memory"]
