"""Memory: the environment, and its step as one operation with its kernel."""

from megastep.envs.memory.memory import Memory, MemoryStep, memory_step

__all__ = ["Memory", "MemoryStep", "memory_step"]
