"""Keys: the environment, and its step as one operation with its kernel."""

from megastep.envs.keys.keys import Keys, KeysStep, keys_step

__all__ = ["Keys", "KeysStep", "keys_step"]
