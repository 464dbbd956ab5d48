"""MiniGrid: the environment, with the kernel of its step."""

from megastep.envs.minigrid.minigrid import MiniGrid

__all__ = ["MiniGrid"]
