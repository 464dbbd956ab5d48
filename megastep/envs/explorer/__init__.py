"""Explorer: the environment, and its step as one operation with its kernel."""

from megastep.envs.explorer.explorer import Explorer, ExplorerStep, explorer_step

__all__ = ["Explorer", "ExplorerStep", "explorer_step"]
